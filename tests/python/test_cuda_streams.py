"""Streams, threads and devices of CUDA, as `make cuda` runs them. Without a GPU the CPU takes its place: then these
tests are tried themselves, and CUDA is not."""

import contextlib
import threading

import pytest
import torch
from test_other_devices import F64, SHAPE, noise

import prdp_torch as prdp
from prdp_torch import operators

CUDA = torch.cuda.is_available()
DEVICES = [f"cuda:{index}" for index in range(torch.cuda.device_count())] if CUDA else ["cpu"]
pytestmark = pytest.mark.cuda


def stream_of(device):
    return torch.cuda.stream(torch.cuda.Stream(device)) if CUDA else contextlib.nullcontext()


def wait():
    if CUDA:
        torch.cuda.synchronize()


def solve_on(device, solver):
    """u and the gradients of κ and b, on the CPU."""
    kappa = (noise(1, *SHAPE).exp()).to(device).requires_grad_()
    b = noise(3, 1, *SHAPE, seed=1).to(device).requires_grad_()
    u, info = prdp.linear_solve(operators.Diffusion(kappa, 1.0), b, solver, on_failure="return")
    found = (u.detach(), info.status, *torch.autograd.grad(u.square().sum(), (kappa, b)))
    return [t.cpu() for t in found]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("preconditioner", [None, "multigrid"])
def test_every_device_stream_and_thread_gives_the_same_bits(device, preconditioner):
    """Also a thread that was never on the device, and while the device of the caller is another."""
    solver = prdp.CG(60, 1e-9, preconditioner=preconditioner)
    expected = solve_on(DEVICES[0], solver)
    results = []

    def of_another_thread():
        with stream_of(device):
            results.append(solve_on(device, solver))

    with stream_of(device):
        results.append(solve_on(device, solver))
    threads = [threading.Thread(target=of_another_thread) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 3
    for found in results:
        assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))


def test_streams_that_nobody_synchronises_share_a_flow():
    """Each has coarse grids of its own."""
    solver = prdp.CG(100, 1e-9, preconditioner="multigrid")
    step = prdp.Flow((32, 32), dt=1e-3, nu=1e-3, solver=solver, on_failure="return")
    states = [0.1 * noise(2, 2, 32, 32, seed=seed).to(DEVICES[0]) for seed in range(4)]
    wait()
    found = []
    for state in states:
        with stream_of(DEVICES[0]):
            found.append(step(state))
    wait()
    assert all(torch.equal(step(state), u) for state, u in zip(states, found, strict=True))


def test_products_of_dense_matrices_take_no_tf32():
    """Though the network may."""
    n = 64
    a = torch.eye(n) * 4 + noise(n, n).float() / n
    b = noise(5, n, seed=1).float()
    matrix, solver = a.to(DEVICES[0]), prdp.GMRES(max_iter=20, rtol=1e-6)
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        u, info = prdp.linear_solve(matrix, b.to(DEVICES[0]), solver)
        of_function, _ = prdp.linear_solve(operators.Function(lambda v: v @ matrix.mT), b.to(DEVICES[0]), solver)
        product = operators.Matrix(matrix).apply(u)
    finally:
        torch.set_float32_matmul_precision(before)
    assert info.status.eq(int(prdp.SolveStatus.CONVERGED)).all()
    for solution in (u, of_function):
        assert (a.double() @ solution.cpu().double().mT - b.double().mT).norm() <= 2e-6 * b.norm()
    torch.testing.assert_close(product.cpu().double(), u.cpu().double() @ a.double().mT, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_vmap_is_the_batch(device):
    a, b = operators.Heat(SHAPE, 0.3, 1.0), noise(4, 3, 1, *SHAPE).to(device)
    solver = prdp.CG(60, 1e-9)
    mapped = torch.func.vmap(lambda v: prdp.linear_solve(a, v, solver, on_failure="return")[0])(b)
    whole, _ = prdp.linear_solve(a, b.flatten(0, 1), solver)
    assert b.dtype == F64 and torch.equal(mapped.flatten(0, 1), whole)
