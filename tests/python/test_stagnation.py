"""What a solve says that stagnates: nothing near rounding, and once where it stands far above what was asked for."""

import subprocess
import sys
import warnings
from contextlib import contextmanager

import pytest
import torch

import prdp_torch as prdp
from prdp_torch.operators import Diffusion, Function, Poisson, Stencil

F64 = torch.float64


@contextmanager
def told(phrase="STAGNATED"):
    """The warnings with this phrase, each as often as it is due."""
    torch.set_warn_always(True)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            words = []
            yield words
            words += [str(w.message) for w in caught if phrase in str(w.message)]
    finally:
        torch.set_warn_always(False)


def rough(samples, n=48, contrast=4.0):
    """κ that jumps by thousands from cell to cell."""
    noise = torch.randn(samples, n, n, generator=torch.Generator().manual_seed(0))
    return (contrast * noise).exp()


def rotation(**options):
    """A cyclic shift: GMRES(1) finds nothing in it that lowers the residual."""
    return Function(lambda v: v.roll(1, -1), lambda v: v.roll(-1, -1), **options)


def names(info):
    return {prdp.SolveStatus(int(s)).name for s in info.status}


@pytest.mark.parametrize("on_failure", ["raise", "warn", "return", "zero_grad"])
def test_a_residual_far_above_rtol_in_float32_is_told_with_the_remedy(on_failure):
    kappa, b = rough(2), torch.ones(2, 1, 48, 48)
    solver = prdp.CG(5000, rtol=1e-6, preconditioner="diagonal")
    with told() as words:
        _, info = prdp.linear_solve(Diffusion(kappa, boundary=["zero", "flux"]), b, solver, on_failure=on_failure)
    assert names(info) == {"STAGNATED"} and (info.residual > 0.01).all() and not info.solved.any()
    if on_failure in ("return", "zero_grad"):
        assert not words
        return
    (text,) = words
    worst = int(info.residual.argmax())
    assert text.startswith("linear_solve: 2 of 2 samples STAGNATED far above rtol = 1e-06: ")
    assert f"sample {worst} at relative residual {info.residual[worst]:.6g} after {info.iterations[worst]} iter" in text
    assert 'CG with preconditioner="diagonal" on Diffusion' in text and "float64" in text
    with told() as words:  # the remedy
        _, info = prdp.linear_solve(
            Diffusion(kappa.double(), boundary=["zero", "flux"]), b.double(), solver, on_failure=on_failure
        )
    assert info.solved.all() and not words


def test_cycles_that_take_nothing_off_are_told():
    b = torch.eye(8, dtype=F64)[:1]
    with told() as words:
        _, info = prdp.linear_solve(rotation(), b, prdp.GMRES(50, restart=1))
    assert names(info) == {"STAGNATED"} and info.residual == 1.0
    assert len(words) == 1 and "its cycles take nothing more off the residual; take a larger restart" in words[0]
    with told() as words:
        _, info = prdp.linear_solve(rotation(), b, prdp.GMRES(50, restart=8))
    assert info.solved.all() and not words


def test_what_is_told_may_be_wrong_altogether():
    """Nothing but the warning tells: float32 against LAPACK in float64, with a condition number of a million."""
    generator = torch.Generator().manual_seed(0)
    q, _ = torch.linalg.qr(torch.randn(40, 40, dtype=F64, generator=generator))
    a = q @ torch.diag(torch.logspace(0, -6, 40, dtype=F64)) @ q.T
    b = torch.randn(1, 40, dtype=F64, generator=generator)
    with told() as words:
        u, info = prdp.linear_solve(a.float(), b.float(), prdp.GMRES(300, restart=10, rtol=1e-6))
    exact = torch.linalg.solve(a, b[0])
    assert names(info) == {"STAGNATED"} and (u - exact).norm() > 0.5 * exact.norm()
    remedy = "Direct, or float64. If A is singular, name all its null vectors (nullspace). This is said once"
    assert len(words) == 1 and remedy in words[0]


def test_a_residual_above_b_is_told_of_steps_and_of_adjoint_solves():
    """A kernel of the exponential of squares, of condition 1e7: CG may go far from b before it comes near."""
    n, generator = 120, torch.Generator().manual_seed(0)
    x = torch.linspace(0, 1, n, dtype=F64)
    a = torch.exp(-((x[:, None] - x) ** 2) / 0.02) + 1e-6 * torch.eye(n, dtype=F64)
    rough = torch.randn(1, n, dtype=F64, generator=generator)
    step = prdp.ImplicitStep(prdp.operators.Matrix(a), None, prdp.CG(30))
    with told("above ‖b‖") as words:
        step(rough)
        step(rough)
    assert float(step.info.residual) > 1 and "linear_solve: 1 of 1 samples stopped at max_iter = 30" in words[0]
    assert words[0].endswith(
        "take more iterations, a preconditioner, GMRES or Direct; or rtol=0 if so few are meant, "
        "as by PRDPController. This is said once, and again if it gets ten times worse"
    )
    b = (a @ torch.sin(3 * x)).requires_grad_()
    u, info = prdp.linear_solve(a, b, prdp.CG(30, rtol=1e-3))
    with told("above ‖b‖") as words:
        torch.autograd.grad(u @ rough[0], b)
    assert info.solved.all() and float(info.adjoint.residual) > 1
    assert len(words) == 1 and words[0].startswith("adjoint solve: 1 of 1 samples stopped at max_iter = 30")


def test_an_adjoint_solve_is_told_by_its_own_name():
    b = torch.zeros(1, 8, dtype=F64, requires_grad=True)  # solved at once
    with told() as words:
        u, info = prdp.linear_solve(rotation(), b, prdp.GMRES(50, restart=1))
        (u * torch.eye(8, dtype=F64)[:1]).sum().backward()
    assert names(info) == {"CONVERGED"} and names(info.adjoint) == {"STAGNATED"}
    assert len(words) == 1 and words[0].startswith("adjoint solve: 1 of 1 samples STAGNATED far above rtol")


@pytest.mark.parametrize("case", ["rounding", "near rounding", "as loose as was asked", "max_iter"])
def test_no_false_alarm(case):
    torch.manual_seed(0)
    a, b, solver = Poisson((256, 256)), torch.ones(1, 1, 256, 256), prdp.CG(900, preconditioner="multigrid")
    expected = {"STAGNATED"}
    if case == "near rounding":  # above a hundredth of what float32 reaches here, and far above rtol
        a, b, solver = Poisson((100,)), torch.ones(1, 1, 100), prdp.CG(900, rtol=1e-7)
    if case == "as loose as was asked":
        a, b, solver = rotation(), torch.eye(8)[:1] + 1e-3 * torch.randn(1, 8), prdp.GMRES(50, restart=1, rtol=0.2)
    if case == "max_iter":  # as PRDP lets solves end
        solver, expected = prdp.CG(2), {"MAX_ITER"}
    with told() as words:
        _, info = prdp.linear_solve(a, b, solver)
    assert names(info) == expected and not words


SAID_ONCE = """
import torch, prdp_torch as prdp
a = prdp.operators.Function(lambda v: v.roll(1, -1), lambda v: v.roll(-1, -1))
for restart in (1, 1, 2):
    prdp.linear_solve(a, torch.eye(8)[:1], prdp.GMRES(50, restart=restart))
step = prdp.ImplicitStep(a, solver=prdp.MINRES(50))
"""


def wind_in_central_differences(peclet, n=32):
    """-Δu + w·∇u with cells of this Péclet number."""
    west, east = -1 - peclet / 2, -1 + peclet / 2
    coefficients = torch.tensor([4.0, east, west, east, west]).view(1, 5, 1, 1).expand(1, 5, n, n).contiguous()
    return Stencil(coefficients, [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])


def test_iterations_in_vain_are_told():
    a, b = wind_in_central_differences(100.0), torch.randn(2, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    for solver, remedy in [
        (prdp.BiCGStab(100, preconditioner="multigrid"), "upwind differences"),
        (prdp.BiCGStab(3), "GMRES or Direct"),
    ]:
        with told("far above rtol") as words:
            u, info = prdp.linear_solve(a, b, solver)
        assert (u == 0).all() and names(info) == {"MAX_ITER"} and info.residual.min() > 0.99
        assert len(words) == 1 and "2 of 2 samples" in words[0] and "returned zero" in words[0] and remedy in words[0]
        with told("at relative residual") as words:
            prdp.linear_solve(a, b, solver, on_failure="return")
        assert not words
    truth, _ = prdp.linear_solve(a, b, prdp.Direct())
    assert truth.norm() > 0.1


def test_iterates_that_all_gain_nothing_are_told_without_a_tolerance_too():
    """A network behind u = 0 would get no gradient."""
    a = torch.full((8, 8), 0.9, dtype=torch.float64) + 0.1 * torch.eye(8, dtype=torch.float64)
    b = torch.eye(8, dtype=torch.float64)[:2] + 1.0
    b[1] = torch.tensor([1.0, -1.0] * 4)  # Jacobi's method gains on this one
    with told("gained nothing") as words:
        _, info = prdp.linear_solve(a, b, prdp.Jacobi(3, rtol=0.0))
    assert names(info) == {"MAX_ITER"} and info.iterations.tolist() == [0, 3] and info.residual[0] > 0.1
    assert len(words) == 1 and "1 of 2 samples gained nothing: sample 0 returned zero" in words[0]
    assert "as the last of 3 iterates was worse" in words[0]
    assert "Jacobi on Matrix: take more iterations if its diagonal dominates A, else CG if A is" in words[0]
    with told("gained nothing") as words:
        prdp.linear_solve(a, b[1:], prdp.Jacobi(3, rtol=0.0))
        prdp.linear_solve(a, b, prdp.Jacobi(0, rtol=0.0))
        prdp.linear_solve(a, b, prdp.Jacobi(3, rtol=0.0), on_failure="return")
    assert not words


def test_it_is_said_once():
    done = subprocess.run([sys.executable, "-W", "always", "-c", SAID_ONCE], capture_output=True, text=True, check=True)
    assert done.stderr.count("STAGNATED far above") == 1 and "This is said once" in done.stderr


WORSE = """
import torch, prdp_torch as prdp
solver = prdp.CG(60, rtol=1e-6, preconditioner="multigrid")
for n, jump in ((64, 1e3), (64, 2e3), (96, 1e5), (96, 1e5)):
    kappa = torch.ones(1, n, n)
    kappa[:, 20:40, 20:40] = jump
    prdp.linear_solve(prdp.operators.Diffusion(kappa), torch.ones(1, 1, n, n), solver)
"""


def test_it_is_said_again_where_it_is_ten_times_worse():
    done = subprocess.run([sys.executable, "-W", "always", "-c", WORSE], capture_output=True, text=True, check=True)
    assert done.stderr.count("STAGNATED far above") == 2


def test_direct_steps_of_a_flow_at_their_rounding_are_solved():
    """Their residuals are twice rtol, and the floor is about rtol: an iteration might go on there, Direct cannot."""
    flow = prdp.Flow((32, 32), 0.1, 0.003, boundary="wall", wall_velocity={(0, "high"): 1.0}, solver=prdp.Direct())
    states = flow.rollout(torch.zeros(1, 2, 32, 32), 40)
    assert flow.info.solved.all()
    exact = flow.double().rollout(torch.zeros(1, 2, 32, 32, dtype=F64), 40)
    assert (states - exact).norm() <= 1e-6 * exact.norm()


@pytest.mark.parametrize("max_iter", [1000, 10_000])
def test_sweeps_that_stall_a_little_above_rtol_end_there(max_iter):
    """Rounding holds Jacobi at a residual of 1.2e-5 on this Burgers operator; float64 goes on."""
    n = 200
    x = torch.arange(1, n + 1) / (n + 1) * 2 * torch.pi
    u = ((x.sin() + 0.5 * (2 * x).sin()) / 1.3).expand(3, 1, n)
    step = prdp.Burgers((n,), nu=1e-3, dt=50 / (n + 1), solver=prdp.Jacobi(max_iter))
    step(u)
    assert step.info.solved.all() and (step.info.iterations < 600).all() and (step.info.residual < 2e-5).all()
    step(u.double())
    assert (step.info.status == 1).all() and (step.info.residual <= 1e-5).all()


def smooth(samples, n):
    x = (torch.arange(n, dtype=F64) + 0.5) / n
    m = torch.arange(1, 4)
    waves = torch.cos(torch.pi * m[:, None] * x)
    weights = torch.randn(samples, 3, 3, dtype=F64, generator=torch.Generator().manual_seed(0)) / (m[:, None] + m)
    return torch.exp(1.2 * torch.einsum("bij,iy,jx->byx", weights, waves, waves))


@pytest.mark.parametrize("method, counts, warm", [
    (lambda k: prdp.CG(k, preconditioner="multigrid"), (1, 2, 3), False),
    (lambda k: prdp.BiCGStab(k, preconditioner="multigrid"), (1,), False),
    (lambda k: prdp.GMRES(k, restart=2, preconditioner="multigrid"), (1,), False),
    (prdp.Multigrid, (1, 2, 3, 4), False),
    (lambda k: prdp.CG(k, preconditioner="diagonal"), (100, 200), False),
    (prdp.MINRES, (50, 150), False),
    (prdp.Jacobi, (1, 2, 20, 64, 65, 400), True),
    (prdp.SteepestDescent, (1, 20, 100), True),
], ids=["CG", "BiCGStab", "GMRES", "Multigrid", "diagonal", "MINRES", "Jacobi", "SteepestDescent"])  # fmt: skip
def test_what_max_iter_ended_is_no_stagnation(method, counts, warm):
    """Of float32, where float64 has the same residual after as many iterations, however near to ε ‖A‖ ‖u‖ that is. All
    of these are above twice ε ‖|A| |u|‖. That of a solution that is rounded is below it."""
    n = 128
    kappa, b, start = smooth(4, n), torch.ones(4, 1, n, n, dtype=F64), None
    if warm:
        start = prdp.linear_solve(Diffusion(kappa), b, prdp.Direct())[0]
        start = start * (1 + 1e-3 * torch.sin(3 * torch.linspace(0, 1, n, dtype=F64)))
    compared = 0
    with told() as words:
        for k in counts:
            _, exact = prdp.linear_solve(Diffusion(kappa), b, method(k), x0=start)
            of_float = None if start is None else start.float()
            _, info = prdp.linear_solve(Diffusion(kappa.float()), b.float(), method(k), x0=of_float)
            same = (info.residual - exact.residual).abs() < 0.05 * exact.residual
            assert (info.status[same] == prdp.SolveStatus.MAX_ITER).all(), (k, info)
            compared += int(same.sum())
    assert compared > 2 * len(counts) and not words


@pytest.mark.parametrize("method", [prdp.CG, prdp.BiCGStab, prdp.MINRES, prdp.SteepestDescent, prdp.Jacobi, prdp.GMRES])
@pytest.mark.parametrize("k", [0, 1, 3, 10])
def test_a_start_that_is_the_solution_in_float32_is_solved(method, k):
    noise, b = torch.randn(2, 16, 1, 64, 64, dtype=F64, generator=torch.Generator().manual_seed(0))
    kappa = (3 * noise[:, 0]).exp()
    exact, _ = prdp.linear_solve(Diffusion(kappa), b, prdp.Direct())
    _, info = prdp.linear_solve(Diffusion(kappa.float()), b.float(), method(k), x0=exact.float(), on_failure="return")
    assert info.solved.sum() >= 13
