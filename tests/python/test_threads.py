"""Threads over the samples of a batch, each test in a process of its own: torch.set_num_threads stays set."""

import os
import subprocess
import sys

import pytest

SETUP = """
import time, torch, prdp_torch as prdp
torch.manual_seed(0)
def with_threads(count, call):
    torch.set_num_threads(count)
    began = time.perf_counter()
    return call(), time.perf_counter() - began
"""


def run(script, **environment):
    done = subprocess.run(
        [sys.executable, "-c", SETUP + script],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | environment,
    )
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return done.stdout


def test_threads_do_not_change_a_bit():
    assert "5 solvers" in run("""
solvers = [prdp.Jacobi(30, rtol=0), prdp.SteepestDescent(30, rtol=0), prdp.CG(30, rtol=0),
           prdp.GMRES(6, rtol=0, restart=5), prdp.Direct()]
for solver in solvers:
    heat = prdp.Heat((64, 33), 1e-3, 1.0, solver=solver)
    b, g = torch.randn(40, 1, 64, 33), torch.randn(40, 1, 64, 33)
    results = []
    for count in (1, 2, 3):
        u0 = b.clone().requires_grad_()
        def both():
            u = heat(u0)
            u.backward(g)
            return u
        results.append((with_threads(count, both)[0], u0.grad))
    for u, grad in results[1:]:
        assert torch.equal(u, results[0][0]) and torch.equal(grad, results[0][1]), solver
print(len(solvers), "solvers")
""")


def test_threads_do_not_change_a_bit_of_a_stencil_or_its_gradients():
    assert "24 cases" in run("""
solvers = [prdp.Jacobi(30, rtol=0), prdp.CG(30, rtol=0), prdp.GMRES(6, rtol=0, restart=5)]
nearest, far = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)], [(0, 0), (0, -2), (1, 1), (-1, 0), (2, 0)]
cases = 0
for solver in solvers:
    for backward in ("implicit", "unrolled"):
        for offsets in (nearest, far):
            for batch in (1, 24):
                c, b, g = torch.rand(batch, 5, 48, 33), torch.randn(24, 2, 48, 33), torch.randn(24, 2, 48, 33)
                c[:, 0] += 5
                results = []
                for count in (1, 2, 3):
                    leaves = [t.clone().requires_grad_() for t in (c, b)]
                    def both():
                        a = prdp.operators.Stencil(leaves[0], offsets, "periodic")
                        u, _ = prdp.linear_solve(a, leaves[1], solver, backward=backward)
                        return u.detach(), *torch.autograd.grad(u, leaves, g)
                    results.append(with_threads(count, both)[0])
                for other in results[1:]:
                    assert all(map(torch.equal, other, results[0])), (solver, backward, offsets, batch)
                cases += 1
print(cases, "cases")
""")


def test_threads_do_not_change_a_bit_of_one_large_sample():
    """They share its rows, and the set-up: coarse grids, factors and the coefficients of the faces."""
    assert "18 cases" in run("""
from prdp_torch import _C
from prdp_torch.operators import Diffusion, Poisson, Stencil
kappa = torch.exp(torch.randn(1, 190, 201, dtype=torch.float64))
wind = torch.rand(1, 190, 201, dtype=torch.float64)
five = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
operators = {
    "poisson 2D": ((190, 201), lambda k, w: Poisson((190, 201))),
    "poisson 3D": ((34, 31, 35), lambda k, w: Poisson((34, 31, 35))),
    "constant": ((190, 201), lambda k, w: Diffusion(torch.ones_like(k), 500.0, boundary=("flux", "periodic"))),
    "varying": ((190, 201), lambda k, w: Diffusion(k, 1e4, boundary="flux")),
    "wind": ((190, 201), lambda k, w: Stencil(torch.stack([4 + w, -1 - w, -k / k, -k / k, -k / k], 1), five)),
}
solvers = {
    "poisson 2D": [prdp.Direct(), prdp.CG(9, preconditioner="multigrid")],
    "poisson 3D": [prdp.Direct(), prdp.Multigrid(5)],
    "constant": [prdp.Direct()],
    "varying": [prdp.CG(9), prdp.CG(9, preconditioner="multigrid")],
    "wind": [prdp.GMRES(2, restart=8, preconditioner="multigrid"), prdp.BiCGStab(9)],
}
cases = 0
for name, (shape, make) in operators.items():
    for solver in solvers[name]:
        for dtype in (torch.float32, torch.float64):
            k, w, b, g = (t.to(dtype) for t in (kappa, wind, torch.randn(1, 1, *shape), torch.randn(1, 1, *shape)))
            results = []
            for count in (1, 2, 3):
                _C.clear_factorisations()
                leaves = [t.clone().requires_grad_() for t in (b, k)]
                def both():
                    u, _ = prdp.linear_solve(make(leaves[1], w), leaves[0], solver, on_failure="return")
                    return u.detach(), *torch.autograd.grad(u, leaves, g, allow_unused=True)
                results.append(with_threads(count, both)[0])
            for other in results[1:]:
                for mine, theirs in zip(other, results[0]):
                    assert (mine is None) == (theirs is None), name
                    assert mine is None or torch.equal(mine, theirs), (name, solver, dtype)
            cases += 1
print(cases, "cases")
""")


@pytest.mark.alone
@pytest.mark.parametrize("n", [127, 300, 515])
def test_threads_share_a_dense_matrix_and_its_transpose(n):
    assert "8 cases" in run(f"""
cases = 0
for dtype, tolerance in ((torch.float32, 1e-3), (torch.float64, 1e-9)):
    matrix, b, g = torch.randn({n}, {n}), torch.randn(1, {n}, dtype=dtype), torch.randn(1, {n}, dtype=dtype)
    matrix = (matrix + 3 * {n}**0.5 * torch.eye({n})).to(dtype)
    exact = torch.linalg.solve(matrix.double().mT, g.double().mT).mT.to(dtype)
    iterative = [method(60, rtol=tolerance / 100) for method in (prdp.GMRES, prdp.BiCGStab, prdp.Jacobi)]
    for solver in (prdp.Direct(), *iterative):
        results = []
        for count in (1, 2, 3):
            leaf = b.clone().requires_grad_()
            def back():
                u = prdp.linear_solve(matrix, leaf, solver, on_failure="return")[0]
                return torch.autograd.grad(u, leaf, g)[0]
            results.append(with_threads(count, back)[0])
        torch.testing.assert_close(results[0], exact, rtol=tolerance, atol=tolerance)
        assert all(torch.equal(other, results[0]) for other in results[1:]), solver
        cases += 1
print(cases, "cases")
""")


def test_two_threads_share_a_batch():
    """By the work of each, not by the clock: other programs may hold the second core."""
    share = run(
        """
start = prdp.fields.project(torch.randn(64, 3, 64, 64))
step = prdp.NavierStokes((64, 64), 1e-4, 0.1, solver=prdp.GMRES(12, restart=8, rtol=0.0))
with_threads(2, lambda: step(start))
mine, all_threads = time.thread_time(), time.process_time()
for _ in range(4):
    step(start)
print((time.thread_time() - mine) / (time.process_time() - all_threads))
""",
        OMP_WAIT_POLICY="passive",  # a thread that waits does not count as one that works
    )
    assert 0.4 < float(share) < 0.65


def test_dense_matrices_of_a_batch_are_factored_soundly():
    """torch's own batched LU is not, after set_num_threads (pytorch issue 142815)."""
    assert "sound" in run("""
torch.set_num_threads(2)
a = torch.randn(6, 300, 300, dtype=torch.float64) + 300 * torch.eye(300)
b = torch.randn(6, 300, dtype=torch.float64)
times = prdp.operators.Function(lambda v, a: torch.einsum("bij,bj->bi", a, v),
                                lambda v, a: torch.einsum("bji,bj->bi", a, v), (a,))
u, _ = prdp.linear_solve(times, b, prdp.Direct())
assert torch.allclose(torch.einsum("bij,bj->bi", a, u), b, rtol=1e-12, atol=1e-12)
print("sound")
""")


def test_two_threads_that_read_their_reports_do_not_wait_for_each_other():
    """The log of adjoint reports once destroyed tensors, which takes the interpreter's lock, with its own held."""
    assert "both done" in run("""
import threading
def work():
    a = torch.eye(3, dtype=torch.float64) * 2
    for _ in range(400):
        b = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
        u, info = prdp.linear_solve(a, b, prdp.CG(5))
        for _ in range(3):
            u.sum().backward(retain_graph=True)
            assert info.adjoint.status.min() > 0
threads = [threading.Thread(target=work, daemon=True) for _ in range(2)]
for thread in threads: thread.start()
for thread in threads: thread.join(60)
assert not any(thread.is_alive() for thread in threads), "deadlock"
print("both done")
""")
