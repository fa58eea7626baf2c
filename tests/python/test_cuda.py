"""Kernels and the tensor path on a GPU, as `make cuda` runs them. Without a GPU the CPU takes its place: then these
tests are tried themselves, and CUDA is not."""

import contextlib
import os
import warnings

import pytest
import test_gpu_multigrid as multigrid
import torch
from fibers import SHUFFLED, Fibers
from test_gpu_kernels import CASES as OF_KERNELS
from test_gpu_kernels import OPERATORS as WITH_KERNELS
from test_gpu_kernels import agree, right_hand_sides
from test_gpu_kernels import solver as solver_of
from test_other_devices import F64, SHAPE, noise
from test_solves_elsewhere import OPERATORS as MADE_OF_A_FIELD
from test_solves_elsewhere import SOLVERS

import prdp_torch as prdp
from prdp_torch import operators

CUDA = torch.cuda.is_available()
FROM_PTX = bool(os.environ.get("PRDP_PTX"))
DEVICE = torch.device("cuda" if CUDA else "cpu")
pytestmark = pytest.mark.cuda

OPERATORS = {**MADE_OF_A_FIELD, "heat": (lambda nu: operators.Heat(SHAPE, nu, 1.0), torch.tensor(0.3, dtype=F64))}
SILENT = {**SOLVERS, "chebyshev": prdp.Chebyshev(40, 0.0)}
# BiCGStab stops short of rounding, where the derivative of its iterations is noise; see docs/derivatives.md.
FIXED = {
    **SILENT,
    "bicgstab": prdp.BiCGStab(12, 0.0),
    "bicgstab, more": prdp.BiCGStab(20, 0.0),
    "gmres": prdp.GMRES(5, 0.0, restart=4),
}
TOLERANT = {
    "cg, rtol": prdp.CG(60, 1e-9),
    "jacobi, rtol": prdp.Jacobi(900, 1e-9),
    "chebyshev, rtol": prdp.Chebyshev(400, 1e-9),
    "bicgstab, rtol": prdp.BiCGStab(60, 1e-4),
    "minres, rtol": prdp.MINRES(60, 1e-9),
    "minres, diagonal": prdp.MINRES(60, 1e-9, preconditioner="diagonal"),
    "gmres, rtol": prdp.GMRES(60, 1e-9, restart=8),
    "cg, multigrid": prdp.CG(20, 1e-9, preconditioner="multigrid"),
    "multigrid": prdp.Multigrid(40, 1e-9),
    "direct": prdp.Direct(),
}


UNSUITED = {"stencil": ("chebyshev",), "function": ("chebyshev", "multigrid"), "heat": ()}


def pairs(solvers):
    """Each operator with the solvers that it has a spectrum, or coarse grids, for."""
    return [(name, s) for name in OPERATORS for s in solvers if not any(word in s for word in UNSUITED[name])]


def test_every_method_is_among_them():
    assert {type(solver) for solver in (FIXED | TOLERANT).values()} == set(prdp.Solver.__subclasses__())


def set_sync_debug_mode(mode):
    with warnings.catch_warnings():  # setting it warns that it is new, which must not leave it on
        warnings.simplefilter("ignore")
        torch.cuda.set_sync_debug_mode(mode)


@contextlib.contextmanager
def no_waiting(cuda=CUDA):
    """An error where the host waits for the GPU."""
    if not cuda:
        yield
        return
    set_sync_debug_mode("error")
    try:
        yield
    finally:
        set_sync_debug_mode("default")


def test_the_mode_in_which_nobody_waits_is_left_again(monkeypatch):
    modes = []

    def set_and_warn(mode):
        modes.append(mode)
        warnings.warn("Synchronization debug mode is a prototype feature", UserWarning, stacklevel=1)

    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", set_and_warn)
    with pytest.raises(ZeroDivisionError), no_waiting(cuda=True):
        raise ZeroDivisionError
    assert modes == ["error", "default"]


def solve_and_gradients(device, name, solver, **options):
    make, g = OPERATORS[name]
    leaves = [g.to(device).requires_grad_(), noise(3, 1, *SHAPE).to(device).requires_grad_()]
    u, info = prdp.linear_solve(make(leaves[0]), leaves[1], solver, **options)
    return u, torch.autograd.grad(u.square().sum(), leaves), info


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize(("name", "solver"), pairs(FIXED | TOLERANT))
def test_solutions_and_gradients_are_those_of_the_cpu(name, solver, backward):
    of = (FIXED | TOLERANT)[solver]
    (u, gradients, info), (v, others, report) = (
        solve_and_gradients(device, name, of, backward=backward) for device in (DEVICE, "cpu")
    )
    torch.testing.assert_close(u.cpu(), v, rtol=1e-7, atol=1e-9)
    for mine, other in zip(gradients, others, strict=True):
        torch.testing.assert_close(mine.cpu(), other, rtol=1e-6, atol=1e-8)
    assert torch.equal(info.status.cpu(), report.status)


ON_KERNELS = [(name, solver) for name, solver in pairs(SILENT) if name != "function"]


@pytest.mark.parametrize(("name", "solver"), ON_KERNELS)
def test_a_solve_that_nobody_reads_does_not_wait(name, solver):
    options = {"on_failure": "zero_grad"}
    expected, gradients, _ = solve_and_gradients("cpu", name, SILENT[solver])
    make, g = OPERATORS[name]
    leaves = [g.to(DEVICE).requires_grad_(), noise(3, 1, *SHAPE).to(DEVICE).requires_grad_()]

    def solve_and_back():
        u, info = prdp.linear_solve(make(leaves[0]), leaves[1], SILENT[solver], **options)
        return u, info, torch.autograd.grad(u.square().sum(), leaves)

    solve_and_back()  # the first results of a kernel are looked at
    with no_waiting():
        u, info, found = solve_and_back()
    torch.testing.assert_close(u.cpu(), expected, rtol=1e-7, atol=1e-9)
    for mine, other in zip(found, gradients, strict=True):
        torch.testing.assert_close(mine.cpu(), other, rtol=1e-6, atol=1e-8)
    assert (info.status.cpu() == prdp.SolveStatus.MAX_ITER).all()


def captured(function, example):
    """function as a CUDA graph; on the CPU the function itself."""
    if not CUDA:
        return function
    given = example.clone()
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            function(given)
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = function(given)

    def replay(b):
        given.copy_(b)
        graph.replay()
        return result.clone()

    return replay


@pytest.mark.parametrize(("name", "solver"), ON_KERNELS)
def test_a_solve_with_its_gradient_in_a_cuda_graph(name, solver):
    make, g = OPERATORS[name]

    def gradient(b, device=DEVICE):
        leaf = b.detach().requires_grad_()
        u, _ = prdp.linear_solve(make(g.to(device)), leaf, SILENT[solver], on_failure="return")
        return torch.autograd.grad(u.square().sum(), leaf)[0]

    g = g.to(DEVICE)
    replay = captured(gradient, noise(3, 1, *SHAPE).to(DEVICE))
    for seed in (1, 2):
        b = noise(3, 1, *SHAPE, seed=seed)
        torch.testing.assert_close(replay(b.to(DEVICE)).cpu(), gradient(b, "cpu"), rtol=1e-7, atol=1e-9)


def there(a):
    return a.to(DEVICE) if isinstance(a, torch.Tensor) else a.of([t.to(DEVICE) for t in a.tensors])


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize(("name", "method"), OF_KERNELS)
def test_kernels_solve_as_the_loops_of_the_cpu(name, method, dtype, monkeypatch):
    if CUDA:
        monkeypatch.setenv("PRDP_GPU", "required")
    a, b = WITH_KERNELS[name](dtype), right_hand_sides(name, dtype)
    rtol = 1e-5 if dtype == torch.float32 else 1e-12
    of = solver_of(method, rtol=rtol)
    u, info = prdp.linear_solve(there(a), b.to(DEVICE), of, on_failure="return")
    found = u.cpu(), info.__class__(*(part.cpu() if isinstance(part, torch.Tensor) else part for part in info))
    agree(
        found,
        prdp.linear_solve(a, b, of, on_failure="return"),
        dtype,
        slack=5 * rtol / torch.finfo(dtype).eps,
        method=method,
    )
    again = prdp.linear_solve(there(a), b.to(DEVICE), of, on_failure="return")[0]
    assert torch.equal(again, u)


def assert_the_bits_of_fibers(run):
    """`run(device)` gives tensors that are made by the same text in the same order, without what a library of
    mathematics rounds as it likes: on a card as by fibers, and there in any order of threads."""
    with Fibers(threads=1024):
        expected = run("cpu")
    if CUDA:
        found = run(DEVICE)
    else:
        with Fibers(threads=1024, order=SHUFFLED, from_ptx=FROM_PTX):
            found = run("cpu")
    for mine, other in zip(found, expected, strict=True):
        assert torch.equal(mine.cpu(), other)


def solved(a, b, of):
    def run(device):
        on_it = a if device == "cpu" else there(a)
        u, info = prdp.linear_solve(on_it, b.to(device), of, on_failure="return")
        return u, info.residual

    return run


# Two orders of threads on the CPU are no matter of the dtype: there, one will do.
@pytest.mark.parametrize("dtype", [torch.float32, F64] if CUDA or FROM_PTX else [F64])
@pytest.mark.parametrize(("name", "method"), OF_KERNELS)
def test_kernels_give_the_bits_of_the_fibers(name, method, dtype):
    a, b = WITH_KERNELS[name](dtype), right_hand_sides(name, dtype)
    assert_the_bits_of_fibers(solved(a, b, solver_of(method, rtol=0.0, max_iter=3)))


@pytest.mark.parametrize(("name", "method", "dtype"), multigrid.CASES)
def test_cycles_give_the_bits_of_the_fibers(name, method, dtype):
    a, b = multigrid.OPERATORS[name][0](dtype), multigrid.right_hand_sides(name, dtype)
    assert_the_bits_of_fibers(solved(a, b, multigrid.with_cycles(method, max_iter=2, rtol=0.0)))


@pytest.mark.parametrize("solver", [prdp.CG(3, 0.0), prdp.BiCGStab(2, 0.0, preconditioner="diagonal")])
def test_a_team_of_blocks_gives_the_bits_of_the_fibers(solver):
    size = 132  # more cells than a block of a card takes alone
    assert_the_bits_of_fibers(solved(operators.Heat((size, size), 1e-2, 1.0), noise(2, 1, size, size), solver))


def test_flows_and_fields_give_the_bits_of_the_fibers():
    """Forward and back."""

    def run(device):
        step = prdp.Flow((9, 10), nu=0.05, dt=0.01, solver=prdp.CG(3, 0.0), on_failure="return").to(device)
        u = noise(2, 2, 9, 10).to(device).requires_grad_()
        kappa = noise(2, 9, 10, seed=1).exp().to(device).requires_grad_()
        state = step(u)
        solution, _ = prdp.linear_solve(
            operators.Diffusion(kappa, 1.0), noise(2, 1, 9, 10, seed=2).to(device), prdp.CG(3, 0.0), on_failure="return"
        )
        squares = state.square().sum() + solution.square().sum()
        return state.detach(), solution.detach(), *torch.autograd.grad(squares, (u, kappa))

    assert_the_bits_of_fibers(run)


def test_a_solve_with_a_tolerance_in_a_cuda_graph():
    make, g = OPERATORS["stencil"]
    a = make(g.to(DEVICE))
    of = prdp.CG(60, 1e-9)

    def gradient(b):
        leaf = b.detach().requires_grad_()
        return torch.autograd.grad(prdp.linear_solve(a, leaf, of, on_failure="return")[0].square().sum(), leaf)[0]

    replay = captured(gradient, noise(3, 1, *SHAPE).to(DEVICE))
    b = noise(3, 1, *SHAPE, seed=1).to(DEVICE)
    torch.testing.assert_close(replay(b), gradient(b), rtol=0, atol=0)


def test_a_rollout_with_its_gradient_in_a_cuda_graph():
    step = prdp.Heat((9,), 1e-2, 1.0, solver=prdp.CG(6, 0.0), on_failure="return")

    def gradient(u):
        leaf = u.detach().requires_grad_()
        return torch.autograd.grad(step.rollout(leaf, 3)[:, -1].square().sum(), leaf)[0]

    replay = captured(gradient, noise(3, 1, 9).to(DEVICE))
    u = noise(3, 1, 9, seed=1)
    torch.testing.assert_close(replay(u.to(DEVICE)).cpu(), gradient(u), rtol=1e-7, atol=1e-9)


def test_a_network_in_half_precision_around_a_solve():
    make, g = OPERATORS["stencil"]
    a = make(g.float().to(DEVICE))
    network = torch.nn.Conv2d(1, 1, 3, padding=1).to(DEVICE)
    with torch.autocast(DEVICE.type, dtype=torch.bfloat16):
        b = network(noise(3, 1, *SHAPE).float().to(DEVICE))
        u, _ = prdp.linear_solve(a, b, prdp.CG(8, 0.0))
        loss = network(u).float().square().sum()
    loss.backward()
    assert b.dtype == torch.bfloat16 and u.dtype == torch.float32
    full, _ = prdp.linear_solve(a, b.float(), prdp.CG(8, 0.0))
    torch.testing.assert_close(u, full)
    assert all(p.grad.dtype == torch.float32 and p.grad.isfinite().all() for p in network.parameters())
