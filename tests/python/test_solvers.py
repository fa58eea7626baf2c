"""Solves against LAPACK, the published code and the plain-tensor solver; and their guarantees."""

import numpy as np
import pytest
import torch
from helpers import ITERATIVE, SOLVERS, dense_heat, dense_laplacian, field, golden, spd_matrices, statuses
from hypothesis import given, settings
from hypothesis import strategies as st

import prdp_torch as prdp
from prdp_torch import _C, operators

NAMES = {prdp.Jacobi: "jacobi", prdp.SteepestDescent: "sd"}


@pytest.mark.parametrize("name, shape, ks", [("heat1d", (30,), (1, 5, 25)), ("heat2d", (30, 30), (1, 5, 25, 43))])
@pytest.mark.parametrize("solver", NAMES, ids=NAMES.values())
def test_iterates_equal_the_published_code(name, shape, ks, solver):
    g = golden(name)
    u = torch.tensor(g["u"]).view(3, 1, *shape)
    for k in ks:
        heat = prdp.Heat(shape, 1e-3, 1.0, solver=solver(k, rtol=0.0))
        np.testing.assert_allclose(heat(u).flatten(1), g[f"{NAMES[solver]}_K{k}"], rtol=0, atol=1e-10)
        assert heat.info.iterations.tolist() == [k] * 3


@pytest.mark.parametrize("name, shape, ks", [("heat1d", (30,), (1, 5, 25)), ("heat2d", (30, 30), (1, 5, 25, 43))])
def test_jacobi_from_another_start_follows_by_linearity(name, shape, ks):
    g = golden(name)
    u, start = (torch.tensor(g[key]).view(3, 1, *shape) for key in ("u", "u_init"))
    residual = u - operators.Heat(shape, 1e-3, 1.0).apply(start)
    for k in ks:
        correction = prdp.Heat(shape, 1e-3, 1.0, solver=prdp.Jacobi(k, rtol=0.0))(residual)
        np.testing.assert_allclose((start + correction).flatten(1), g[f"jacobi_K{k}_init"], rtol=0, atol=1e-10)


@pytest.mark.parametrize("name, shape", [("heat1d", (30,)), ("heat2d", (30, 30))])
def test_direct_equals_the_published_code(name, shape):
    g = golden(name)
    u = torch.tensor(g["u"]).view(3, 1, *shape)
    result = prdp.Heat(shape, 1e-3, 1.0, solver=prdp.Direct())(u)
    np.testing.assert_allclose(result.flatten(1), g["direct"], rtol=0, atol=1e-10)


@pytest.mark.parametrize("shape", [(1,), (19,), (33,), (4, 9), (17, 2), (3, 5, 4)], ids=str)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dtype, rtol, close", [(torch.float64, 1e-12, 1e-9), (torch.float32, 1e-5, 2e-4)])
def test_converged_solves_equal_lapack(shape, solver, dtype, rtol, close):
    b = field(shape, batch=3)
    for a, matrix in (
        (operators.Poisson(shape), dense_laplacian(shape)),
        (operators.Heat(shape, 1e-3, 1.0), dense_heat(shape)),
    ):
        u, info = prdp.linear_solve(a, b.to(dtype), solver(20000, rtol=rtol))
        assert (info.status > 0).all()
        expected = np.linalg.solve(matrix, b.flatten(1).numpy().T).T
        np.testing.assert_allclose(u.double().flatten(1), expected, rtol=0, atol=close * np.abs(expected).max())


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("layout", ["dense", "csr"])
@pytest.mark.parametrize("batched", [False, True])
def test_matrices_equal_lapack(solver, layout, batched):
    m = spd_matrices(3, 11)
    m = m if batched else m[0]
    b = torch.randn(3, 11, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    expected = torch.linalg.solve(m, b.unsqueeze(-1)).squeeze(-1)
    u, info = prdp.linear_solve(m.to_sparse_csr() if layout == "csr" else m, b, solver(500, rtol=1e-13))
    torch.testing.assert_close(u, expected, rtol=1e-10, atol=1e-11)
    assert info.status.shape == (3,)
    if not batched:
        alone, _ = prdp.linear_solve(m, b[1], solver(500, rtol=1e-13))
        assert alone.shape == (11,)
        torch.testing.assert_close(alone, expected[1], rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("solver", ITERATIVE)
def test_stops_at_the_first_iterate_within_tolerance(solver):
    b = field((25,), batch=1)
    a = operators.Heat((25,), 1e-3, 1.0)
    matrix = dense_heat((25,))

    def true_residual(k):
        u, _ = prdp.linear_solve(a, b, solver(k, rtol=0.0))
        r = b.flatten().numpy() - matrix @ u.flatten().numpy()
        return np.linalg.norm(r) / np.linalg.norm(b)

    _, info = prdp.linear_solve(a, b, solver(1000, rtol=1e-6))
    k = int(info.iterations)
    assert true_residual(k) <= 1e-6 < true_residual(k - 1)
    for budget, expected in ((k - 1, "MAX_ITER"), (k, "CONVERGED"), (k + 1, "CONVERGED")):
        _, info = prdp.linear_solve(a, b, solver(budget, rtol=1e-6))
        assert statuses(info) == [expected]
        assert int(info.iterations) == min(budget, k)


@pytest.mark.parametrize("solver", ITERATIVE)
@pytest.mark.parametrize("k", [0, 1, 2, 7])
def test_no_tolerance_runs_exactly_k_iterations(solver, k):
    _, info = prdp.linear_solve(operators.Heat((20,), 1e-3, 1.0), field((20,)), solver(k, rtol=0.0))
    assert info.iterations.tolist() == [k, k]
    assert statuses(info) == ["MAX_ITER"] * 2


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_tolerance_goes_on_past_exact_convergence(solver, dtype):
    b = field((9,), dtype=dtype)
    u, info = prdp.linear_solve(operators.Heat((9,), 1e-3, 1.0), b, solver(3000, rtol=0.0))
    assert torch.isfinite(u).all()
    assert info.iterations.tolist() == [3000, 3000]
    assert info.residual.max() < 1e-6


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 40), rtol=st.sampled_from([1e-3, 1e-5, 1e-8]), k=st.integers(0, 60))
def test_converged_means_a_small_recomputed_residual(seed, n, rtol, k):
    b = field((n,), batch=3, seed=seed)
    matrix = dense_heat((n,))
    for solver in SOLVERS:
        for dtype in (torch.float64, torch.float32):
            u, info = prdp.linear_solve(operators.Heat((n,), 1e-3, 1.0), b.to(dtype), solver(k, rtol=rtol))
            rhs = b.to(dtype).double().flatten(1).numpy()
            residual = np.linalg.norm(rhs - u.double().flatten(1).numpy() @ matrix.T, axis=1)
            residual /= np.linalg.norm(rhs, axis=1)
            # Of b - A u with rows of three entries, in units of ‖b‖: γ₅ (‖A‖ ‖u‖ + ‖b‖), where ‖u‖ <= ‖b‖ for heat.
            rounding = 5 * torch.finfo(dtype).eps / 2 * (np.linalg.norm(matrix, 2) + 1)
            np.testing.assert_allclose(info.residual.double(), residual, rtol=1e-3, atol=1e-13 + rounding)
            converged = (info.status > 0).numpy()
            assert (residual[converged] <= rtol * 1.0001 + rounding).all()


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["heat", "dense", "csr"])
def test_a_sample_does_not_depend_on_its_batch_to_the_last_bit(solver, dtype, kind):
    batch, n = 64, 37
    if kind == "heat":
        a, b = operators.Heat((n,), 1e-3, 1.0), field((n,), batch=batch, dtype=dtype)
    else:
        m = spd_matrices(1, n, dtype=dtype)[0]
        a = operators.Matrix(m.to_sparse_csr() if kind == "csr" else m)
        b = field((n,), batch=batch, dtype=dtype)[:, 0]

    def run(rows):
        rows = rows.clone().requires_grad_()
        u, info = prdp.linear_solve(a, rows, solver(12, rtol=1e-4), on_failure="return")
        (u**3).sum().backward()
        return u.detach(), rows.grad, info

    u, grad, info = run(b)
    order = torch.randperm(batch, generator=torch.Generator().manual_seed(3))
    spoiled = b.clone()
    spoiled[1::2] = float("nan")
    for rows, index in ((b[order], order), (spoiled[::2].contiguous(), torch.arange(0, batch, 2))):
        v, other, report = run(rows)
        assert torch.equal(v, u[index]) and torch.equal(other, grad[index])
        assert torch.equal(report.iterations, info.iterations[index])
    v, other, report = run(spoiled)
    assert torch.equal(v[::2], u[::2]) and torch.equal(other[::2], grad[::2])
    assert statuses(report)[1::2] == ["NONFINITE_INPUT"] * (batch // 2)
    assert torch.equal(v[1::2], torch.zeros_like(v[1::2])) and torch.equal(other[1::2], torch.zeros_like(v[1::2]))
    for i in (0, 31, 63):
        v, other, report = run(b[i : i + 1])
        assert torch.equal(v[0], u[i]) and torch.equal(other[0], grad[i])


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dtype, exponents", [(torch.float32, (-110, -60, 60, 110)), (torch.float64, (-900, 900))])
def test_powers_of_two_pass_through_exactly(solver, dtype, exponents):
    heat = prdp.Heat((23,), 1e-3, 1.0, solver=solver(9, rtol=1e-6))
    b, g = field((23,), dtype=dtype), field((23,), seed=5, dtype=dtype)

    def run(b, g):
        b = b.clone().requires_grad_()
        u = heat(b)
        u.backward(g)
        return u.detach(), b.grad, heat.info.iterations, heat.adjoint_info.iterations

    u, lam, count, adjoint_count = run(b, g)
    for e in exponents:
        scaled_u, scaled_lam, *counts = run(torch.ldexp(b, torch.tensor(e)), torch.ldexp(g, torch.tensor(-e)))
        assert torch.equal(scaled_u, torch.ldexp(u, torch.tensor(e)))
        assert torch.equal(scaled_lam, torch.ldexp(lam, torch.tensor(-e)))
        assert torch.equal(counts[0], count) and torch.equal(counts[1], adjoint_count)


@pytest.mark.parametrize("solver", SOLVERS)
def test_right_hand_sides_of_any_strides(solver):
    heat = prdp.Heat((6, 9), 1e-3, 1.0, solver=solver(8))
    b = field((6, 9), batch=4)
    transposed = b.transpose(2, 3).contiguous().transpose(2, 3)
    strided = torch.stack([b, b], -1)[..., 0]
    expanded = b[:1].expand(4, 1, 6, 9)
    assert torch.equal(heat(transposed), heat(b)) and torch.equal(heat(strided), heat(b))
    assert torch.equal(heat(expanded), heat(expanded.contiguous()))


@settings(deadline=None, max_examples=30)
@given(
    shape=st.lists(st.integers(1, 18), min_size=1, max_size=2).map(tuple),
    seed=st.integers(0, 1000),
    rtol=st.sampled_from([0.0, 1e-4, 1e-9]),
)
def test_loops_equal_plain_tensors(shape, seed, rtol):
    b = field(shape, batch=3, seed=seed)
    a = operators.Heat(shape, 1e-3, 1.0)
    for solver in SOLVERS:
        u, info = prdp.linear_solve(a, b, solver(6, rtol=rtol))
        v, report = _C.solve_with_tensors(b, a.tensors, a.kind, a.shape, a.parameters, False, solver.method, 6, rtol)
        torch.testing.assert_close(u, v, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(info.residual, report[1], rtol=1e-6, atol=1e-13)


def test_poisson_converges_in_about_as_many_jacobi_sweeps_as_the_paper():
    x = torch.arange(1, 31, dtype=torch.float64) / 31
    b = torch.sin(2 * torch.pi * x)[None, None]
    _, info = prdp.linear_solve(operators.Poisson((30,)), b, prdp.Jacobi(2000))
    # The mode is an eigenvector: ρ = cos(2π/31), so ln(1e-5)/ln(ρ) sweeps.
    assert int(info.iterations) == int(np.ceil(np.log(1e-5) / np.log(np.cos(2 * np.pi / 31)))) == 557


def test_heat_1d_converges_in_the_papers_25_jacobi_sweeps():
    g = golden("heat1d")
    heat = prdp.Heat((30,), 1e-3, 1.0, solver=prdp.Jacobi(100))
    heat(torch.tensor(g["u"], dtype=torch.float32)[:, None])
    assert heat.info.iterations.tolist() == [25, 25, 25]


@pytest.mark.parametrize("preconditioner", [None, "diagonal", "multigrid"])
def test_a_batch_may_begin_with_a_sample_that_needs_no_iteration(preconditioner):
    b = torch.zeros(3, 1, 9, 8, dtype=torch.float64)
    b[1] = 1.0
    b[2, 0, 3] = -2.0
    u, info = prdp.linear_solve(
        prdp.operators.Heat((9, 8), 0.1, 1.0), b, prdp.CG(100, rtol=1e-12, preconditioner=preconditioner)
    )
    alone, _ = prdp.linear_solve(
        prdp.operators.Heat((9, 8), 0.1, 1.0), b[1:], prdp.CG(100, rtol=1e-12, preconditioner=preconditioner)
    )
    assert info.iterations[0] == 0
    assert torch.equal(u[1:], alone)
