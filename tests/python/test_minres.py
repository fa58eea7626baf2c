"""MINRES, against least squares over Krylov spaces and dense LAPACK."""

import pytest
import torch
from stand_in_device import StandIn

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64
N = 40


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def symmetric(*eigenvalues):
    q, _ = torch.linalg.qr(noise(N, N, seed=1))
    a = q @ torch.diag(torch.cat([torch.linspace(low, high, N // len(eigenvalues), dtype=F64)
                                  for low, high in eigenvalues])) @ q.T  # fmt: skip
    return (a + a.T) / 2


MATRICES = {
    "definite": symmetric((1, 50)),
    "negative": symmetric((-50, -1)),
    "indefinite": symmetric((-20, -1), (0.5, 30)),
}


def helmholtz(dtype=F64, shift=-500.0, n=24):
    """Eigenvalues of both signs, none near zero."""
    return operators.Diffusion(torch.ones(1, n, n, dtype=dtype), shift=shift)


@pytest.mark.parametrize("k", [1, 2, 7, 19])
@pytest.mark.parametrize("name", MATRICES)
def test_each_iterate_has_the_least_residual_of_its_krylov_space(name, k):
    a, b = MATRICES[name], noise(3, N)
    u, info = prdp.linear_solve(a, b, prdp.MINRES(k, 0.0))
    for sample in range(3):
        v, basis = b[sample], []
        for _ in range(k):
            for q in basis:
                v = v - (v @ q) * q
            basis.append(v / v.norm())
            v = a @ basis[-1]
        space = a @ torch.stack(basis, 1)
        least = (b[sample] - space @ torch.linalg.lstsq(space, b[sample]).solution).norm() / b[sample].norm()
        torch.testing.assert_close(info.residual[sample], least, rtol=1e-8, atol=1e-12)
    torch.testing.assert_close((b - u @ a).norm(dim=1) / b.norm(dim=1), info.residual, rtol=1e-8, atol=1e-13)
    assert info.operator_applications.tolist() == [k + 1] * 3


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("name", MATRICES)
def test_solutions_are_those_of_lapack(name, dtype):
    a, b = MATRICES[name].to(dtype), noise(3, N).to(dtype)
    u, info = prdp.linear_solve(a, b, prdp.MINRES(300, 1e-5 if dtype == F32 else 1e-12))
    assert info.solved.all()
    torch.testing.assert_close(u, torch.linalg.solve(a, b.T).T, rtol=0, atol=1e-3 if dtype == F32 else 1e-10)


def test_helmholtz_where_cycles_of_gmres_stand_still():
    a, b = helmholtz(), noise(2, 1, 24, 24)
    u, info = prdp.linear_solve(a, b, prdp.MINRES(1000, 1e-9))
    assert info.solved.all() and (info.operator_applications < 400).all()
    torch.testing.assert_close(u, prdp.linear_solve(a, b, prdp.Direct())[0], rtol=1e-6, atol=1e-9)
    _, cycles = prdp.linear_solve(a, b, prdp.GMRES(max_iter=40, restart=10, rtol=1e-9))
    assert not cycles.solved.any()


@pytest.mark.parametrize("preconditioner", ["diagonal", "multigrid", "own"])
def test_preconditioned(preconditioner):
    kappa = noise(2, 32, 32).exp()
    a, b = operators.Diffusion(kappa, shift=1.0), noise(2, 1, 32, 32)
    if preconditioner == "own":
        scale = 0.5 + noise(1, 1, 32, 32, seed=5).abs()
        preconditioner = operators.Function(lambda r: r * scale, lambda r: r * scale)
    u, info = prdp.linear_solve(a, b, prdp.MINRES(600, 1e-10, preconditioner=preconditioner))
    assert info.solved.all()
    if preconditioner == "multigrid":
        assert (info.iterations <= 20).all()
    torch.testing.assert_close(u, prdp.linear_solve(a, b, prdp.Direct())[0], rtol=1e-6, atol=1e-9)


def test_an_indefinite_preconditioner_breaks_down_and_says_so():
    a, b = helmholtz(shift=-5000.0), noise(2, 1, 24, 24)  # whose diagonal is negative
    with pytest.raises(torch.linalg.LinAlgError, match=r"MINRES.*preconditioner is not positive definite"):
        prdp.linear_solve(a, b, prdp.MINRES(100, preconditioner="diagonal"))


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_gradients_are_those_of_finite_differences(backward):
    b = noise(2, 1, 5, 4).requires_grad_()
    kappa = noise(2, 5, 4, seed=3).exp().requires_grad_()

    def u(kappa, b):
        a = operators.Diffusion(kappa, shift=-60.0)
        k, rtol = (200, 1e-13) if backward == "implicit" else (6, 0.0)
        return prdp.linear_solve(a, b, prdp.MINRES(k, rtol), backward=backward)[0]

    assert torch.autograd.gradcheck(u, (kappa, b), atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("as_tensors", [False, True])
def test_a_diagonal_of_both_signs_breaks_down_and_says_so(as_tensors):
    """Before it takes a square root of what is negative: it is no number that has left its range."""
    kappa = torch.rand(1, 5, 6, dtype=F64, generator=torch.Generator().manual_seed(3)) + 0.3
    a, b = operators.Diffusion(kappa, shift=-60.0), noise(1, 1, 5, 6)
    assert a.diagonal().min() < 0 < a.diagonal().max()
    solver = prdp.MINRES(300, 1e-11, preconditioner="diagonal")
    if as_tensors:
        d = a.diagonal()
        solver = prdp.MINRES(300, 1e-11, preconditioner=operators.Function(lambda r: r / d, symmetric=True))
    with pytest.raises(torch.linalg.LinAlgError, match=r"BREAKDOWN.*preconditioner is not positive definite"):
        prdp.linear_solve(a, b, solver)
    u, info = prdp.linear_solve(a, b, solver, on_failure="return")
    assert u.isfinite().all() and info.residual.item() <= 1


def test_a_zero_on_the_diagonal_names_what_needs_none():
    a = torch.tensor([[2.0, 1.0], [1.0, 0.0]], dtype=F64)
    with pytest.raises(torch.linalg.LinAlgError, match="take MINRES without it"):
        prdp.linear_solve(a, noise(1, 2), prdp.MINRES(9, preconditioner="diagonal"))
    assert prdp.linear_solve(a, noise(1, 2), prdp.MINRES(9))[1].solved.all()


def test_samples_fail_alone():
    a = torch.stack([MATRICES["indefinite"], torch.zeros(N, N, dtype=F64), MATRICES["indefinite"], torch.eye(N)])
    b = noise(4, N)
    b[2, 3] = torch.nan
    u, info = prdp.linear_solve(a, b, prdp.MINRES(200, 1e-10), on_failure="return")
    names = [prdp.SolveStatus(int(s)).name for s in info.status]
    assert names == ["CONVERGED", "BREAKDOWN", "NONFINITE_INPUT", "CONVERGED"]
    assert u.isfinite().all()
    alone, _ = prdp.linear_solve(a[:1], b[:1], prdp.MINRES(200, 1e-10))
    assert torch.equal(u[:1], alone)


def test_singular_systems_and_their_least_solution():
    a = operators.Diffusion(noise(2, 9, 8).exp(), boundary="flux")
    b = noise(2, 1, 9, 8)
    b -= b.mean((-2, -1), keepdim=True)
    u, info = prdp.linear_solve(a, b, prdp.MINRES(300, 1e-11))
    assert info.solved.all() and u.mean((-2, -1)).abs().max() < 1e-12
    torch.testing.assert_close(a.apply(u), b, rtol=1e-8, atol=1e-9)
    _, info = prdp.linear_solve(a, b + 1.0, prdp.MINRES(300, 1e-11), on_failure="return")
    assert (info.status == prdp.SolveStatus.INCONSISTENT).all()


@pytest.mark.parametrize("gap", [1e-8, 1e-6])
@pytest.mark.parametrize("method", [prdp.MINRES, prdp.CG])
def test_where_rounding_takes_over_an_earlier_iterate_is_returned(method, gap):
    """In float32, near a null space, recursive residuals fall while the true ones grow past that of zero; and CG on an
    indefinite matrix breaks down far above it."""
    q, _ = torch.linalg.qr(noise(100, 100, seed=3))
    values = torch.linspace(-2, -0.05, 49, dtype=F64), torch.linspace(0.05, 3, 50, dtype=F64), torch.tensor([gap])
    a, b = (q * torch.cat(values)) @ q.T, noise(2, 100, seed=4).float()
    a = ((a + a.T) / 2).float()
    for k in (50, 100, 200, 475, 1000):
        u, info = prdp.linear_solve(a, b, method(k, 1e-7), on_failure="return")
        residual = (b.double() - u.double() @ a.double()).norm(dim=1) / b.double().norm(dim=1)
        torch.testing.assert_close(info.residual.double(), residual, rtol=0.3, atol=0.03)
        # That of zero is 1. CG may end above it by max_iter, as it is made for definite matrices.
        assert (residual < 1)[info.failed if method is prdp.CG else slice(None)].all(), (k, residual)


def test_a_matrix_that_is_not_symmetric_makes_nothing_worse_and_is_named():
    a, b = 3 * torch.eye(N, dtype=F64) + noise(N, N, seed=2), noise(3, N)
    with pytest.warns(UserWarning, match="MINRES on Matrix: A is not symmetric .* take GMRES"):
        u, info = prdp.linear_solve(a, b, prdp.MINRES(50, 1e-8))
    assert not info.solved.any() and (info.residual <= 1).all()
    torch.testing.assert_close((b - u @ a.T).norm(dim=1) / b.norm(dim=1), info.residual, rtol=1e-6, atol=1e-9)


def test_many_products_in_vain_name_the_asymmetry_though_no_residual_grew():
    """The two channels of a complex Helmholtz equation, whose coupling has another sign in the second."""

    def product(v):
        real, imaginary = v[:, :1], v[:, 1:]
        diffused = [4 * w - w.roll(1, 2) - w.roll(-1, 2) - w.roll(1, 3) - w.roll(-1, 3) for w in (real, imaginary)]
        return torch.cat([diffused[0] - 1.1 * real + 0.3 * imaginary, diffused[1] - 1.1 * imaginary - 0.3 * real], 1)

    b = noise(2, 2, 12, 12)
    with pytest.warns(UserWarning, match="2 of 2 samples .* MINRES on Function: A is not symmetric"):
        _, info = prdp.linear_solve(operators.Function(product), b, prdp.MINRES(300, 1e-9))
    assert not info.solved.any() and (info.residual < 1).all()


@pytest.mark.filterwarnings(
    "ignore:.* STAGNATED far above rtol", "ignore:.* did not reach rtol", "error:.*not symmetric"
)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("method", [prdp.CG, prdp.MINRES])
def test_a_symmetric_derivative_by_differences_is_not_called_asymmetric(method, dtype):
    s, u = noise(24, 24).to(dtype), noise(2, 24, seed=1).to(dtype)
    s = s + s.T + 24 * torch.eye(24, dtype=dtype)
    h = torch.finfo(dtype).eps ** 0.5

    def function(x):
        return x @ s + x**3

    a = operators.Function(lambda v: (function(u + h * v) - function(u)) / h, symmetric=True)
    prdp.linear_solve(a, noise(2, 24, seed=2).to(dtype), method(150, 1e-13), backward="none")


@pytest.mark.parametrize("rtol", [0.0, 1e-9])
@pytest.mark.parametrize("preconditioner", [None, "diagonal"])
def test_tensors_and_other_devices_give_what_the_loops_give(rtol, preconditioner):
    kappa, b = noise(3, 9, 8).exp(), noise(3, 1, 9, 8)
    solver = prdp.MINRES(12 if rtol == 0 else 300, rtol, preconditioner=preconditioner)
    u, info = prdp.linear_solve(operators.Diffusion(kappa, shift=1.0), b, solver)
    device = StandIn()
    with device:
        there = operators.Diffusion(device.send(kappa), shift=1.0)
        v, report = prdp.linear_solve(there, device.send(b), solver)
    torch.testing.assert_close(device.fetch(v), u, rtol=1e-6, atol=1e-9)
    assert torch.equal(device.fetch(report.status), info.status)


def test_a_start_is_taken_and_a_step_uses_it():
    a, b = helmholtz(), noise(2, 1, 24, 24)
    u, info = prdp.linear_solve(a, b, prdp.MINRES(1000, 1e-9))
    _, again = prdp.linear_solve(a, b, prdp.MINRES(1000, 1e-6), x0=u + 1e-4 * noise(2, 1, 24, 24, seed=4))
    assert (again.iterations < info.iterations).all()
    step = prdp.Heat((30,), nu=1e-2, dt=1.0, solver=prdp.MINRES(100, 1e-10))
    exact = prdp.Heat((30,), nu=1e-2, dt=1.0, solver=prdp.Direct())
    state = noise(2, 1, 30)
    torch.testing.assert_close(step.rollout(state, 3), exact.rollout(state, 3), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("way", ["loops", "tensors", "unrolled"])
def test_iterations_after_convergence_leave_a_named_null_space_alone(way, dtype):
    """What rounding puts there grows as fast as the residual falls."""
    kappa = (0.3 + noise(1, 12, 12).abs()).to(dtype)
    b = noise(2, 1, 12, 12).to(dtype)
    a = operators.Diffusion(kappa, boundary="periodic")
    exact = torch.linalg.pinv(operators.Diffusion(kappa.double(), boundary="periodic").dense(), hermitian=True)
    b = b - b.mean((2, 3), keepdim=True)
    if way == "tensors":
        given = operators.Diffusion(kappa, boundary="periodic")
        a = operators.Function(given.apply, symmetric=True, nullspace="constant")
    rhs = b.clone().requires_grad_()
    backward = "unrolled" if way == "unrolled" else "implicit"
    u, _ = prdp.linear_solve(a, rhs, prdp.MINRES(400, 0.0), backward=backward)
    expected = (exact @ b.double().flatten(1).T).T
    bound = 1e-5 if dtype == F32 else 1e-12
    assert (u.detach().double().flatten(1) - expected).norm() < bound * expected.norm()
    if way == "unrolled":
        return  # its derivative beyond convergence is that of rounding
    (gradient,) = torch.autograd.grad((u * b).sum(), rhs)
    assert (gradient.double().flatten(1) - expected).norm() < bound * expected.norm()
