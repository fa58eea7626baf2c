"""What the message of a failed solve says: the operator, the sample, the number and the remedy, case by case."""

import warnings

import pytest
import torch
from helpers import field

import prdp_torch as prdp
from prdp_torch import operators

GRID = torch.arange(8, dtype=torch.float64).view(1, 1, 8).sin() + 2.0
SINGULAR = torch.ones(2, 2, dtype=torch.float64)
SWAP = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)
TURN = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64)
STRONG = 0.1 * torch.eye(3, dtype=torch.float64) + 0.9  # symmetric positive definite, yet Jacobi's ρ is 1.8
E1 = torch.tensor([1.0, 0.0], dtype=torch.float64)


def hyperdiffusion(dtype=torch.float64):
    """1 + Δ² on a periodic grid: Jacobi diverges."""
    coefficients = torch.tensor([7.0, -4.0, -4.0, 1.0, 1.0], dtype=dtype).view(1, 5, 1).expand(1, 5, 8)
    return operators.Stencil(coefficients, [(0,), (-1,), (1,), (-2,), (2,)], "periodic")


def flow_state(mean=0.0):
    b = field((4, 4), batch=1, channels=3)
    b[:, 2] += mean - b[:, 2].mean()
    return b


FLOW = operators.NavierStokes(0.5 * field((4, 4), batch=1, channels=3, seed=1), 1e-3, 0.1)
WILD = operators.NavierStokes(field((4, 4), batch=1, channels=3, seed=1), 1e-3, 1.0)
BURGERS = operators.Burgers(50.0 * field((8,), batch=1, seed=2), 1e-4, 1.0)
ZERO = operators.Stencil(torch.tensor([[[0.0], [1.0], [-1.0]]]).expand(1, 3, 8).double(), [(0,), (-1,), (1,)])
BUDGET = {"max_iter": 2000}
BY_DIAGONAL = {"max_iter": 9, "preconditioner": "diagonal"}
NOT_SYMMETRIC = r"A is not symmetric \(‖A v - Aᵀ v‖ is [\d.]+ ‖A v‖ for a v of no structure\); take GMRES"
INDEFINITE = r"A is symmetric but not definite to float\d\d: take MINRES"
RADIUS = r"as an eigenvalue of I - D⁻¹A is larger than 1 in magnitude; take CG if A is positive definite, else MINRES"

TABLE = [
    # status, operator, right-hand side, solver, what is said
    ("DIVERGED", STRONG, torch.ones(3).double() * GRID[0, 0, :3], prdp.Jacobi(500), f"Jacobi on Matrix: .*{RADIUS}"),
    ("DIVERGED", STRONG.to_sparse_csr(), GRID[0, 0, :3], prdp.Jacobi(500), f"Jacobi on Matrix: .*{RADIUS}"),
    ("DIVERGED", hyperdiffusion(), GRID, prdp.Jacobi(500), f"Jacobi on Stencil: .*{RADIUS}"),
    ("DIVERGED", WILD, flow_state(), prdp.SteepestDescent(2000), f"SteepestDescent on NavierStokes: .*{NOT_SYMMETRIC}"),
    ("BREAKDOWN", SWAP, E1, prdp.SteepestDescent(9), f"SteepestDescent on Matrix: .*{INDEFINITE}"),
    ("BREAKDOWN", SWAP, E1, prdp.CG(9), f"CG on Matrix: r·A r is zero for a residual r: {INDEFINITE}"),
    ("BREAKDOWN", TURN, E1, prdp.CG(9), f"CG on Matrix: r·A r is zero for a residual r: {NOT_SYMMETRIC}"),
    ("BREAKDOWN", SINGULAR, torch.tensor([1.0, 2.0]).double(), prdp.CG(**BY_DIAGONAL),
     f'CG with preconditioner="diagonal" on Matrix: .*{INDEFINITE}'),
    ("BREAKDOWN", SINGULAR, torch.tensor([1.0, 2.0]).double(), prdp.GMRES(9, restart=2),
     r"GMRES\(2\) on Matrix: .*A is singular, and b lies outside its range, .*take a b without"),
    ("BREAKDOWN", SINGULAR, E1, prdp.Direct(),
     "Direct on Matrix: A is singular to float64, or nearly so; GMRES solves it for any b"),
    ("BREAKDOWN", ZERO, GRID, prdp.SteepestDescent(9), f"SteepestDescent on Stencil: .*{NOT_SYMMETRIC}"),
    ("BREAKDOWN", operators.Function(lambda v: v.flip(1), symmetric=True), E1[None], prdp.CG(9),
     f"CG on Function: .*{INDEFINITE}"),
    ("ZERO_DIAGONAL", FLOW, flow_state(), prdp.Jacobi(9),
     r"in row \(2, 0, 0\), Jacobi on NavierStokes: the pressure rows have a zero diagonal; take GMRES\."),
    ("ZERO_DIAGONAL", FLOW, flow_state(), prdp.CG(**BY_DIAGONAL),
     'CG with preconditioner="diagonal" on NavierStokes: the pressure rows have a zero diagonal; take GMRES'),
    ("ZERO_DIAGONAL", FLOW, flow_state(), prdp.GMRES(**BY_DIAGONAL),
     r'GMRES\(10\) with preconditioner="diagonal" on NavierStokes: .* take GMRES without it'),
    ("ZERO_DIAGONAL", operators.Diffusion(1e20 ** torch.linspace(-1.5, 1, 8).view(1, 8)), torch.ones(1, 1, 8),
     prdp.CG(**BY_DIAGONAL), "it divides by the diagonal of A, whose least number is lost beside the largest; take"),
    ("ZERO_DIAGONAL", SWAP, E1, prdp.Jacobi(9), r"in row \(0,\), Jacobi on Matrix: it divides by .*; take MINRES"),
    ("ZERO_DIAGONAL", ZERO, GRID, prdp.Jacobi(9), r"in row \(0, 0\), Jacobi on Stencil: it divides by .*; take GMRES"),
    *[("INCONSISTENT", FLOW, flow_state(2.0), solver,
       rf"{name} on NavierStokes: [\d.]+ % of b is the mean of its pressure channel, which no flow can have")
      for name, solver in (("SteepestDescent", prdp.SteepestDescent(9)),
                           (r"GMRES\(10\)", prdp.GMRES(9)), ("Direct", prdp.Direct()),
                           (r'GMRES\(10\) with preconditioner="multigrid"',
                            prdp.GMRES(9, preconditioner="multigrid")))],
    *[("OVERFLOW", 0.1 * torch.eye(3), torch.full((3,), 3e38), solver,
       rf"{name} on Matrix: a number left the range of float32 \(‖A‖ is 0.1, ‖b‖ is 5.2e\+38\); take float64")
      for name, solver in (("Jacobi", prdp.Jacobi(9)), ("SteepestDescent", prdp.SteepestDescent(9)), ("CG", prdp.CG(9)),
                           (r"GMRES\(10\)", prdp.GMRES(9)), ("Direct", prdp.Direct()))],
    ("OVERFLOW", 0.1 * torch.eye(2).double(), 1.7e308 * E1, prdp.CG(9),
     r"CG on Matrix: a number left the range of float64 .*; scale A and b"),
    *[("OVERFLOW", (0.1 * torch.eye(3) + 0.9).to(dtype), torch.ones(3, dtype=dtype), prdp.Jacobi(1500, rtol=0.0),
       rf"the iterates grew beyond the range of {name} \(‖A‖ is 2.8, .*\), as an eigenvalue of .*; take CG if")
      for name, dtype in (("float32", torch.float32), ("float64", torch.float64))],
    ("NONFINITE_INPUT", operators.Heat((8,), 1e-3, 1.0), GRID / 0.0, prdp.Chebyshev(9),
     r"at index \(0, 0\), Chebyshev on Heat: the right-hand side is NaN or Inf there; look at the state"),
    ("NONFINITE_INPUT", operators.Poisson((8,)), GRID * torch.nan, prdp.CG(9), "CG on Poisson: the right-hand side"),
    ("NONFINITE_OPERATOR", operators.Burgers(GRID / 0.0, 1e-3, 0.1), GRID, prdp.GMRES(9),
     r"at index \(0, 0\), GMRES\(10\) on Burgers: A is made of a NaN or Inf;"),
]  # fmt: skip


@pytest.mark.parametrize("case", range(len(TABLE)), ids=lambda i: f"{TABLE[i][0]}-{TABLE[i][4][:30]}")
def test_a_failure_names_operator_sample_number_and_remedy(case):
    status, a, b, solver, said = TABLE[case]
    with pytest.raises(
        torch.linalg.LinAlgError, match=f"linear_solve: 1 of 1 samples failed: sample 0 {status}.*{said}"
    ):
        prdp.linear_solve(a, b, solver)


def test_the_samples_that_failed_are_named_and_the_others_are_not():
    matrices = torch.stack([torch.eye(3).double(), STRONG, torch.eye(3).double()])
    with pytest.raises(torch.linalg.LinAlgError, match=r"1 of 3 samples failed: sample 1 DIVERGED .* Jacobi on Matrix"):
        prdp.linear_solve(matrices, torch.ones(3, 3).double() + GRID[0, 0, :3], prdp.Jacobi(500))


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_an_adjoint_solve_says_what_is_wrong_with_the_loss(backward):
    heat = prdp.Heat((8,), 1e-3, 1.0, prdp.CG(9), backward=backward)
    u = heat(GRID.clone().requires_grad_())
    with pytest.raises(
        torch.linalg.LinAlgError,
        match=r"adjoint solve: 1 of 1 .* sample 0 NONFINITE_INPUT at index \(0, 0\), CG on Heat: the cotangent is NaN "
        "or Inf there; look at the loss, at the scale of a GradScaler, or",
    ):
        u.backward(torch.full_like(u, torch.nan))


def test_a_loss_of_the_mean_pressure_is_named():
    u, _ = prdp.linear_solve(FLOW, flow_state().requires_grad_(), prdp.GMRES(30, restart=8))
    with pytest.raises(
        torch.linalg.LinAlgError,
        match=r"INCONSISTENT .*GMRES\(8\) on NavierStokes: 100 % of the cotangent is the mean of its pressure, "
        "which the step leaves free; take the mean off the pressure that the loss is made of",
    ):
        u[:, 2].mean().backward()


def test_the_message_of_a_stepper_is_the_same():
    flow = prdp.NavierStokes((4, 4), 1e-3, 0.1, prdp.Jacobi(3))
    with pytest.raises(
        torch.linalg.LinAlgError, match="Jacobi on NavierStokes: the pressure rows have a zero diagonal"
    ):
        flow(flow_state())
    with pytest.warns(UserWarning, match="step 1 of 1: linear_solve: .* Jacobi on NavierStokes: the pressure rows"):
        flow.on_failure = "warn"
        flow.rollout(flow_state(), 1)


def test_a_reason_that_is_the_same_is_said_once():
    b = torch.full((64, 2), torch.nan, dtype=torch.float64)
    with pytest.raises(torch.linalg.LinAlgError) as error:
        prdp.linear_solve(SINGULAR + torch.eye(2).double(), b, prdp.CG(9))
    assert str(error.value).startswith(
        "linear_solve: 64 of 64 samples failed: sample 0 NONFINITE_INPUT at index (0,), CG on Matrix: the right-hand "
        "side is NaN or Inf there; look at the state that it is made of; sample 1 NONFINITE_INPUT at index (0,); "
        "sample 2 NONFINITE_INPUT at index (0,); sample 3 NONFINITE_INPUT at index (0,); and 60 more. With"
    )


def test_symmetric_is_not_believed_where_it_is_false():
    a = operators.Function(lambda v: v @ TURN.T, symmetric=True)
    with pytest.raises(torch.linalg.LinAlgError, match=NOT_SYMMETRIC):
        prdp.linear_solve(a, E1[None], prdp.CG(9))


def test_a_warning_names_the_users_line(always):
    matrix = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    step = prdp.ImplicitStep(matrix, solver=prdp.Jacobi(3), on_failure="warn")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        torch.nn.Sequential(step)(torch.ones(1, 2))
        prdp.linear_solve(matrix, torch.ones(1, 2), prdp.Jacobi(3), on_failure="warn")
    assert [warning.filename for warning in said] == [__file__, __file__]


def test_a_warning_comes_out_whatever_the_users_file_is_called(always):
    scope = {}
    text = "def solve(prdp, a, b): return prdp.linear_solve(a, b, prdp.Jacobi(3), on_failure='warn')"
    exec(compile(text, "/home/\udce9.py", "exec"), scope)
    with pytest.warns(UserWarning, match="MAX_ITER|ended far above"):
        scope["solve"](prdp, torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.ones(1, 2))


def test_an_overflow_in_the_derivative_of_iterations_names_the_implicit_one():
    generator = torch.Generator().manual_seed(0)
    kappa = torch.where(torch.rand(2, 45, generator=generator) < 0.5, 1.0, 1000.0).requires_grad_()
    b = torch.randn(2, 1, 45, generator=generator)
    b = b - b.mean(-1, keepdim=True)
    solver = prdp.GMRES(200, restart=70)
    u, _ = prdp.linear_solve(operators.Diffusion(kappa, boundary="flux"), b, solver, backward="unrolled")
    said = 'left the range of float32 in the derivative of the iterations; take backward="implicit"'
    with pytest.raises(torch.linalg.LinAlgError, match=said):
        u.square().sum().backward()
    u, _ = prdp.linear_solve(operators.Diffusion(kappa, boundary="flux"), b, solver)
    u.square().sum().backward()
    assert kappa.grad.isfinite().all()
