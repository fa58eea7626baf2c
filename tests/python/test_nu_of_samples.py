"""A nu for each sample: (batch,) where a number is for all. Each sample has the result that it has alone."""

import pytest
import torch
from fibers import Fibers

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64
NU = (0.3, 0.02, 1.7)


def noise(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def heat(*shape):
    return lambda nu, _: operators.Heat(shape, nu, 0.01, length=(1.0, 2.0, 0.7)[: len(shape)]), 1, shape


def burgers(*shape):
    return lambda nu, winds: operators.Burgers(winds, nu, 0.01), len(shape), shape


def navier_stokes(*shape):
    return lambda nu, winds: operators.NavierStokes(winds, nu, 0.05), 3, shape


CASES = {
    "heat 1D": heat(19),
    "heat 2D": heat(7, 9),
    "heat 3D": heat(3, 4, 5),
    "burgers 1D": burgers(18),
    "burgers 2D": burgers(5, 8),
    "navier-stokes": navier_stokes(4, 6),
}
SOLVERS = {
    "jacobi": lambda: prdp.Jacobi(8),
    "steepest descent": lambda: prdp.SteepestDescent(7),
    "chebyshev": lambda: prdp.Chebyshev(9),
    "cg": lambda: prdp.CG(6),
    "multigrid": lambda: prdp.CG(4, preconditioner="multigrid"),
    "bicgstab": lambda: prdp.BiCGStab(5),
    "gmres": lambda: prdp.GMRES(2, restart=5),
    "direct": lambda: prdp.Direct(),
}
PAIRS = [
    (case, solver)
    for case in CASES
    for solver in SOLVERS
    if case.startswith("heat")
    or (solver in ("bicgstab", "gmres", "direct") if case != "navier-stokes" else solver in ("gmres", "direct"))
]


def problem(case, dtype, winds_of_all=False):
    """make(nu, winds), nu, winds, b"""
    make, channels, shape = CASES[case]
    winds = noise(1 if winds_of_all else 3, channels, *shape, seed=1, dtype=dtype)
    b = noise(3, channels, *shape, seed=2, dtype=dtype)
    if channels == 3:
        b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)
    return make, torch.tensor(NU, dtype=dtype), winds, b


def solved(make, nu, winds, b, solver, **options):
    """u and the gradients for nu, the winds and b."""
    leaves = [t.clone().requires_grad_() for t in (nu, winds, b)]
    u, info = prdp.linear_solve(make(leaves[0], leaves[1]), leaves[2], solver, on_failure="return", **options)
    cotangent = u.detach().flip(-1).clone()
    if u.shape[1] == 3 and u.dim() == 4:
        cotangent[:, 2] = 0.0
    grads = torch.autograd.grad(u, leaves, cotangent, allow_unused=True)
    return u.detach(), info, [torch.zeros(()) if g is None else g for g in grads]


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
@pytest.mark.parametrize("case, solver", PAIRS)
def test_each_sample_is_as_alone(case, solver, dtype, backward):
    if solver == "direct" and backward == "unrolled":
        backward = "implicit"
    make, nu, winds, b = problem(case, dtype)
    u, info, (nu_bar, winds_bar, b_bar) = solved(make, nu, winds, b, SOLVERS[solver](), backward=backward)
    for i in range(3):
        one = [t[i : i + 1] for t in (winds, b)]
        alone, its, (nu_alone, winds_alone, b_alone) = solved(make, nu[i], *one, SOLVERS[solver](), backward=backward)
        assert torch.equal(u[i : i + 1], alone) and torch.equal(info.status[i : i + 1], its.status)
        tolerance = {"rtol": 1e-11, "atol": 1e-12} if dtype == F64 else {"rtol": 2e-4, "atol": 1e-5}
        if solver == "chebyshev" and backward == "unrolled":  # its radius has the dtype of nu
            torch.testing.assert_close(b_bar[i : i + 1], b_alone, **tolerance)
        else:
            assert torch.equal(b_bar[i : i + 1], b_alone)
        torch.testing.assert_close(nu_bar[i], nu_alone.to(dtype), **tolerance)
        if not case.startswith("heat"):
            torch.testing.assert_close(winds_bar[i : i + 1], winds_alone, **tolerance)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("case", CASES)
def test_gradients(case, backward):
    """First and second, against finite differences; winds that all samples share."""
    make, nu, winds, b = problem(case, F64, winds_of_all=True)
    solver = prdp.GMRES(40, 1e-13, restart=30) if case == "navier-stokes" else prdp.BiCGStab(60, 1e-13)

    def u(nu, winds, b):
        found = prdp.linear_solve(make(nu, winds), b, solver, backward=backward, on_failure="return")[0]
        return found[:, :2] if case == "navier-stokes" else found

    if case == "navier-stokes":
        b = b.clone()
        b[:, 2] = 0.0
    leaves = [t.requires_grad_() for t in (nu, winds)]
    torch.autograd.gradcheck(lambda nu, w: u(nu, w, b), leaves, atol=1e-5, rtol=1e-4, check_undefined_grad=False)
    if backward == "implicit":
        torch.autograd.gradgradcheck(lambda nu: u(nu, winds.detach(), b).square(), nu, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("case", CASES)
def test_forward_mode(case):
    make, nu, winds, b = problem(case, F64)
    tangent = torch.tensor([1.0, -2.0, 0.5], dtype=F64)
    solver = prdp.Direct()

    def u(nu):
        return prdp.linear_solve(make(nu, winds), b, solver)[0]

    _, found = torch.func.jvp(u, (nu,), (tangent,))
    step = 1e-6
    expected = (u(nu + step * tangent) - u(nu - step * tangent)) / (2 * step)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("make", [
    lambda nu: prdp.Heat((17,), nu, 0.01, prdp.CG(9, 1e-8)),
    lambda nu: prdp.Burgers((16,), nu, 0.01, prdp.BiCGStab(9, 1e-8), picard_steps=2),
    lambda nu: prdp.NavierStokes((4, 6), nu, 0.01, prdp.GMRES(9, 1e-8, restart=20)),
], ids=["heat", "burgers", "navier-stokes"])  # fmt: skip
def test_steppers(make):
    """Steps, a rollout, and a Parameter, each sample as alone."""
    step = make(torch.nn.Parameter(torch.tensor(NU, dtype=F64)))
    channels, shape = (3 if isinstance(step, prdp.NavierStokes) else 1), step.shape
    u = 0.3 * noise(3, channels, *shape)
    states = step.rollout(u, 4)
    assert torch.equal(states[:, 1], step(u)) and step.rollout(u, 4).shape == (3, 5, channels, *shape)
    (step.rollout(u, 4)[:, -1, :1] ** 2).sum().backward()
    assert [name for name, _ in step.named_parameters()] == ["nu"]
    for i, nu in enumerate(NU):
        alone = make(torch.nn.Parameter(torch.tensor(nu, dtype=F64)))
        assert torch.equal(alone.rollout(u[i : i + 1], 4), states[i : i + 1])
        (alone.rollout(u[i : i + 1], 4)[:, -1, :1] ** 2).sum().backward()
        torch.testing.assert_close(step.nu.grad[i], alone.nu.grad, rtol=1e-9, atol=1e-12)


def test_vmap_over_nu_is_one_solve():
    make, nu, winds, b = problem("burgers 1D", F64)
    solver = prdp.BiCGStab(9, 1e-10)
    together, _ = prdp.linear_solve(make(nu, winds), b, solver)

    def one(nu, winds, b):
        return prdp.linear_solve(make(nu, winds[None]), b[None], solver)[0][0]

    assert torch.equal(torch.func.vmap(one)(nu, winds, b), together)


def test_compiled():
    step = prdp.Burgers((16,), torch.tensor(NU), 0.01, prdp.BiCGStab(9, 1e-6))
    compiled = torch.compile(step, backend="aot_eager", fullgraph=True, dynamic=True)
    for batch in (3, 5):
        step.nu = torch.rand(batch, generator=torch.Generator().manual_seed(batch))
        u = noise(batch, 1, 16, dtype=F32)
        assert torch.equal(compiled(u), step(u))


def test_on_a_gpu():
    """The kernels' text, over fibers."""
    for case, solver in (("heat 2D", "cg"), ("heat 2D", "multigrid"), ("burgers 2D", "bicgstab"),
                         ("navier-stokes", "gmres")):  # fmt: skip
        make, nu, winds, b = problem(case, F64)
        expected = solved(make, nu, winds, b, SOLVERS[solver]())
        with Fibers(threads=32):
            found = solved(make, nu, winds, b, SOLVERS[solver]())
        torch.testing.assert_close(found[0], expected[0], rtol=1e-9, atol=1e-10)
        for mine, other in zip(found[2], expected[2], strict=True):
            torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("case", ["heat 1D", "burgers 1D"])
def test_a_nu_that_is_not_allowed_fails_alone(case):
    make, nu, winds, b = problem(case, F64)
    solver = prdp.BiCGStab(30, 1e-10)
    bad = nu.clone()
    bad[1] = -1.0
    with pytest.raises(ValueError, match="nu must be finite and >= 0, got -1 in sample 1"):
        prdp.linear_solve(make(bad, winds), b, solver)
    for value in (-1.0, float("nan")):
        bad[1] = value
        leaf = bad.clone().requires_grad_()
        u, info = prdp.linear_solve(make(leaf, winds), b, solver, on_failure="zero_grad")
        assert info.status.tolist() == [
            prdp.SolveStatus.CONVERGED,
            prdp.SolveStatus.NONFINITE_OPERATOR,
            prdp.SolveStatus.CONVERGED,
        ]
        alone, _ = prdp.linear_solve(make(nu, winds), b, solver)
        assert torch.equal(u[::2], alone[::2])
        (grad,) = torch.autograd.grad(u.sum(), leaf)
        assert grad.isfinite().all() and grad[1] == 0 and (grad[::2] != 0).all()


def test_mistakes():
    b = torch.zeros(3, 1, 9)
    with pytest.raises(ValueError, match="Heat: the values of nu hold 2 samples, the vector holds 3"):
        prdp.linear_solve(operators.Heat((9,), torch.ones(2), 0.1), b, prdp.CG(3))
    with pytest.raises(TypeError, match="Heat: the values of nu are float64 but the vector is float32"):
        prdp.linear_solve(operators.Heat((9,), torch.ones(3, dtype=F64), 0.1), b, prdp.CG(3))
    with pytest.raises(ValueError, match=r"Heat: nu must be a number, a 0-dimensional tensor, or \(batch,\), one for"):
        operators.Heat((9,), torch.ones(3, 1), 0.1)
    with pytest.raises(ValueError, match="Heat: nu must be finite and >= 0, got -1 in sample 1"):
        prdp.Heat((9,), torch.tensor([1.0, -1.0, 1.0]), 0.1, prdp.CG(3))
