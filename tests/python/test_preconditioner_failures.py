"""Preconditioners that fail, that are refused, or that nobody else holds when a backward pass needs them."""

import dataclasses

import pytest
import torch
from helpers import field, statuses
from test_preconditioner import K_TERMS, MATRICES, cg, function, gmres, rhs

import prdp_torch as prdp
from prdp_torch import operators


@pytest.mark.parametrize("solver", [cg, gmres])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_zero_on_the_diagonal_is_refused_before_iterating(solver, backward):
    matrices = MATRICES.clone()
    matrices[1, 2, 2] = 0.0
    crow, col = torch.arange(0, 37, 6), torch.arange(6).repeat(6)
    for a in (matrices, operators.Matrix.csr(crow, col, matrices.flatten(1), 6)):
        b = rhs((6,)).requires_grad_()
        with pytest.raises(
            torch.linalg.LinAlgError, match=r"sample 1 ZERO_DIAGONAL in row \(2,\).* divides by the diag"
        ):
            prdp.linear_solve(a, b, solver(5))
        u, info = prdp.linear_solve(a, b, solver(5), backward=backward, on_failure="return")
        assert statuses(info)[1] == "ZERO_DIAGONAL" and info.iterations.tolist()[1] == 0
        assert float(info.residual[1]) == 1.0 and not u[1].any() and u[0].any()
        u.sum().backward()
        assert not b.grad[1].any() and b.grad[0].any() and bool(b.grad.isfinite().all())
    flow = operators.NavierStokes(field((4, 4), channels=3), 1e-3, 1e-2)
    with pytest.raises(torch.linalg.LinAlgError, match="ZERO_DIAGONAL"):
        prdp.linear_solve(flow, field((4, 4), channels=3), solver(3))


@pytest.mark.parametrize("solver", [cg, gmres])
def test_a_function_with_a_zero_in_one_sample_spoils_no_gradient(solver):
    k = K_TERMS.repeat(3, 1)
    k[1, 3] = -1.0
    b, k = rhs((6,)).requires_grad_(), k.requires_grad_()
    a = function(k, symmetric=True)
    u, info = prdp.linear_solve(a, b, solver(3), backward="unrolled", on_failure="return")
    assert statuses(info)[1] == "ZERO_DIAGONAL"
    u.sum().backward()
    for gradient in (b.grad, k.grad):
        assert bool(gradient.isfinite().all()) and not gradient[1].any() and gradient[0].any()


def test_an_indefinite_matrix_breaks_down_as_without():
    b = torch.ones(1, 2, dtype=torch.float64)
    matrix = torch.diag(torch.tensor([1.0, -1.0], dtype=torch.float64))
    for solver in (prdp.CG(5), cg(5, 1e-5)):
        assert statuses(prdp.linear_solve(matrix, b, solver, on_failure="return")[1]) == ["BREAKDOWN"]


def test_arguments_are_checked():
    with pytest.raises(
        ValueError, match="Jacobi: the method Jacobi takes no preconditioner; CG, BiCGStab, GMRES and MINRES take one"
    ):
        prdp.Jacobi(3, preconditioner="diagonal")
    for kind in (prdp.Chebyshev, prdp.SteepestDescent, prdp.Direct):
        with pytest.raises(ValueError, match=f"{kind.__name__}: the method {kind.__name__} takes no preconditioner"):
            kind(3, preconditioner="diagonal")
    allowed = "allowed: None, 'diagonal', 'multigrid', or an operator$"
    with pytest.raises(ValueError, match=f"CG: unknown preconditioner 'stokes'; {allowed}"):
        prdp.CG(3, preconditioner="stokes")
    with pytest.raises(TypeError, match=r"GMRES: preconditioner must be a name or an operator of .*, got 3"):
        prdp.GMRES(3, preconditioner=3)
    with pytest.raises(ValueError, match=r"its diagonal, which Jacobi and preconditioner=.diagonal. divide by"):
        prdp.linear_solve(operators.Function(lambda v: 2 * v), field((4,)), cg(3))
    again = dataclasses.replace(cg(3), max_iter=4)
    assert (again.preconditioner, again.max_iter) == ("diagonal", 4)
    assert dataclasses.replace(again, preconditioner=None).preconditioner is None


@pytest.mark.parametrize("solver", [prdp.CG, prdp.GMRES, prdp.BiCGStab])
def test_a_preconditioner_without_values_is_refused(solver):
    scale = torch.ones(8, device="meta")
    inverse = operators.Function(lambda v, t: v * t, tensors=(scale,), symmetric=True)
    with pytest.raises(
        ValueError, match="Function: one of its tensors is on meta, the vector on cpu; it has no values"
    ):
        prdp.linear_solve(operators.Heat((8,), 1e-3, 0.1), torch.ones(2, 1, 8), solver(5, preconditioner=inverse))


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("way", ["step", "rollout", "implicit_step", "solve", "replaced"])
def test_a_backward_pass_holds_the_preconditioner_that_it_needs(way, backward):
    """When nobody else does any more."""

    def run(x, kept=None):
        m = operators.Function(lambda r: r / 1.5, lambda r: r / 1.5)
        solver = prdp.GMRES(50, preconditioner=m)
        if kept is not None:
            kept.append(m)
        a = operators.Heat((30,), 1e-3, 1.0)
        if way == "solve":
            return prdp.linear_solve(a, x, solver, backward=backward)[0].sum()
        if way == "implicit_step":
            step = prdp.ImplicitStep(a, None, solver, backward)
        else:
            step = prdp.Heat((30,), 1e-3, 1.0, solver, backward)
        u = step.rollout(x, 2)[:, -1] if way == "rollout" else step(x)
        if way == "replaced" and kept is None:
            step.preconditioner = None
            step(x)
        return u.sum()

    x = torch.randn(2, 1, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    (found,) = torch.autograd.grad(run(x), x)
    alive = []
    (expected,) = torch.autograd.grad(run(x, alive), x)
    assert torch.equal(found, expected)


def test_failures_of_an_own_preconditioner_are_not_blamed_on_a():
    a, b = operators.Heat((8, 8), 1e-2, 1.0), torch.ones(1, 1, 8, 8).cumsum(-1)

    def solve(apply):
        m = operators.Function(apply, symmetric=True)
        return prdp.linear_solve(a, b, prdp.CG(50, preconditioner=m))

    with pytest.raises(torch.linalg.LinAlgError, match="its preconditioner hands out NaN or Inf for a vector of ones"):
        solve(lambda v: v * torch.nan)
    with pytest.raises(torch.linalg.LinAlgError, match="its preconditioner is not definite, or A is not"):
        solve(lambda v: 0 * v)
    with pytest.raises(ValueError, match=r"preconditioner: Heat: expected \(batch, 1, 4, 4\), got \(1, 1, 8, 8\)"):
        prdp.linear_solve(a, b, prdp.CG(50, preconditioner=operators.Heat((4, 4), 1e-2, 1.0)))
    with pytest.raises(ValueError, match="preconditioner: Function: matvec must return what it was given"):
        solve(lambda v: v[..., :4])


def test_what_is_singular_to_float32_is_sent_to_float64():
    with pytest.raises(torch.linalg.LinAlgError, match="singular to float32, or nearly so; take float64"):
        prdp.linear_solve(torch.tensor([[1.0, 2.0], [2.0, 4.0]]), torch.ones(2), prdp.Direct())
    with pytest.raises(torch.linalg.LinAlgError, match=r"row \(1,\) of A is zero.* has lost them, take float64"):
        prdp.linear_solve(torch.diag(torch.tensor([1.0, 0.0, 2.0])), torch.ones(3), prdp.Direct())


@pytest.mark.parametrize("solver", [prdp.CG, prdp.MINRES, prdp.GMRES, prdp.BiCGStab])
@pytest.mark.parametrize("write", [lambda r: r.mul_(0.5), lambda r: r.copy_(2 * r)])
def test_a_preconditioner_that_writes_into_the_residual_is_refused(solver, write):
    """It would change what the method goes on with, and the report with it."""
    m = operators.Function(write, symmetric=True)
    with pytest.raises(ValueError, match="preconditioner: Function: matvec changes its arguments in place"):
        prdp.linear_solve(MATRICES[0], rhs((6,)), solver(9, preconditioner=m))
    with torch.inference_mode(), pytest.raises(ValueError, match="changes its arguments in place"):
        prdp.linear_solve(MATRICES[0].clone(), rhs((6,)).clone(), solver(9, preconditioner=m))


def test_minres_tells_nan_of_its_preconditioner_from_one_that_is_not_definite():
    for bad, said in ((torch.nan, "hands out NaN or Inf"), (-1.0, "is not positive definite")):
        m = operators.Function(lambda r, bad=bad: bad * r, symmetric=True)
        with pytest.raises(torch.linalg.LinAlgError, match=f"its preconditioner {said}"):
            prdp.linear_solve(MATRICES[0], rhs((6,)), prdp.MINRES(9, preconditioner=m))


@pytest.mark.parametrize("solver", [prdp.GMRES(max_iter=5, restart=3), prdp.BiCGStab(5)])
def test_a_preconditioner_that_hands_out_nothing_is_named(solver):
    solver.preconditioner = operators.Function(lambda r: 0 * r)
    b = torch.ones(1, 4, dtype=torch.float64)
    with pytest.raises(torch.linalg.LinAlgError, match="its preconditioner maps a vector of ones to zero"):
        prdp.linear_solve(2 * torch.eye(4, dtype=torch.float64), b, solver)


def test_minres_with_the_diagonal_of_a_negative_definite_operator_names_a_way():
    solver = prdp.MINRES(20, preconditioner="diagonal")
    with pytest.raises(torch.linalg.LinAlgError, match="take MINRES without it, or CG where A is negative definite"):
        prdp.linear_solve(operators.Poisson((8,)), torch.randn(1, 1, 8, dtype=torch.float64), solver)


NOT_SYMMETRIC = r"not symmetric \(‖M⁻¹v - M⁻ᵀv‖ is [\d.]+ ‖M⁻¹v‖ for a v of no structure\); take GMRES"
NOT_LINEAR = r"not linear: M⁻¹\(-2 v\) is not -2 M⁻¹ v"


@pytest.mark.usefixtures("always")
@pytest.mark.parametrize("claims_symmetry", [False, True])
@pytest.mark.parametrize(
    "solver, apply, said",
    [
        (prdp.CG(400, 1e-12), lambda r: r + 0.3 * r.roll(1, -1), NOT_SYMMETRIC),
        (prdp.MINRES(400, 1e-12), lambda r: r + 0.3 * r.roll(1, -1), NOT_SYMMETRIC),
        (prdp.GMRES(400, 1e-12), lambda r: r + r.tanh(), NOT_LINEAR),
    ],
)
def test_a_preconditioner_that_does_not_suit_the_method_is_named_where_rtol_is_not_reached(
    solver, apply, said, claims_symmetry
):
    kappa, b = 0.2 + 5 * field((16, 16)).abs()[:, 0], field((16, 16))
    inverse = operators.Function(apply, symmetric=claims_symmetry)
    solver = dataclasses.replace(solver, preconditioner=inverse)
    with pytest.warns(UserWarning, match=f"did not reach rtol = 1e-12: .* its preconditioner is {said}"):
        _, info = prdp.linear_solve(operators.Diffusion(kappa, 0.5), b, solver, backward="none")
    assert not info.solved.all()
