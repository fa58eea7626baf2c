"""Null spaces of graphs: one vector for each part of a graph that no edge joins to the others."""

import time

import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def rings(parts, n, dtype, seed=0):
    """The Laplacian of `parts` rings of n nodes with weights that require grad, dense; these; its null vectors."""
    g = torch.Generator().manual_seed(seed)
    i = torch.arange(parts * n)
    j = i // n * n + (i + 1) % n
    w = (torch.rand(parts * n, generator=g, dtype=torch.float64) + 0.5).to(dtype).requires_grad_()
    rows, columns = torch.cat([i, j, i, j]), torch.cat([j, i, i, j])
    values = torch.cat([-w, -w, w, w])
    vectors = torch.nn.functional.one_hot(i // n, parts).T.to(dtype).contiguous()
    return (rows, columns, values), w, vectors


def dense(entries, size):
    rows, columns, values = entries
    return torch.zeros(size, size, dtype=values.dtype).index_put((rows, columns), values, accumulate=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("parts, n", [(1, 7), (1, 8), (1, 33), (3, 9), (5, 8)])
@pytest.mark.parametrize("reduced", ["sum", "mean"])
def test_the_sum_of_a_solution_has_no_gradient(reduced, parts, n, dtype):
    """It is that of the null space, so that all of its cotangent lies outside what Aᵀ reaches."""
    entries, w, vectors = rings(parts, n, dtype)
    b = torch.randn(parts * n, dtype=dtype, generator=torch.Generator().manual_seed(1))
    b = b - vectors.T @ (vectors @ b) / n
    for solver in (prdp.CG(3 * n, rtol=1e-5), prdp.GMRES(4, rtol=1e-4, restart=n - 1), prdp.Direct()):
        a = operators.Matrix(dense(entries, parts * n), nullspace=vectors)
        u, _ = prdp.linear_solve(a, b, solver)
        (gradient,) = torch.autograd.grad(getattr(u, reduced)(), w, retain_graph=True)
        assert gradient.abs().max() == 0


def test_gradients_of_graphs_in_parts_are_those_of_the_pseudoinverse():
    parts, n = 4, 6
    entries, w, vectors = rings(parts, n, torch.float64)
    b = torch.randn(parts * n, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    b = b - vectors.T @ (vectors @ b) / n
    cotangent = torch.randn(parts * n, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    matrix = dense(entries, parts * n)
    exact = torch.linalg.pinv(matrix + vectors.T @ vectors) @ b  # regular, and the same for such a b
    (expected,) = torch.autograd.grad(exact, w, cotangent - vectors.T @ (vectors @ cotangent) / n, retain_graph=True)
    shuffled = torch.randperm(parts * n, generator=torch.Generator().manual_seed(3))
    for order in (torch.arange(parts * n), shuffled):  # vectors whose entries lie together, and apart
        a = operators.Matrix(matrix[order][:, order], nullspace=vectors[:, order])
        u, _ = prdp.linear_solve(a, b[order], prdp.CG(60, rtol=1e-12))
        torch.testing.assert_close(u, exact[order], rtol=1e-9, atol=1e-10)
        (gradient,) = torch.autograd.grad(u, w, cotangent[order], retain_graph=True)
        torch.testing.assert_close(gradient, expected, rtol=1e-8, atol=1e-9)


@pytest.mark.alone
def test_many_parts_cost_little():
    """A named null vector for each of 300 graphs: seconds, as every pair was multiplied."""
    parts, n = 300, 30
    _, w, vectors = rings(parts, n, torch.float64)
    i = torch.arange(parts * n)
    before, after = i // n * n + (i - 1) % n, i // n * n + (i + 1) % n
    w = w.detach()
    columns, values = torch.stack([i, before, after], 1), torch.stack([w + w[before], -w[before], -w], 1)
    columns, order = columns.sort(1)
    crow = torch.arange(0, 3 * parts * n + 1, 3)
    a = operators.Matrix.csr(
        crow, columns.flatten(), values.gather(1, order).flatten(), (parts * n, parts * n), nullspace=vectors
    )
    b = torch.randn(parts * n, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    b = b - vectors.T @ (vectors @ b) / n
    began = time.perf_counter()
    _, info = prdp.linear_solve(a, b, prdp.CG(300, rtol=1e-9))
    assert info.solved.all() and time.perf_counter() - began < 0.8


def test_a_vector_that_is_no_null_vector_is_named_among_many():
    entries, _, vectors = rings(5, 8, torch.float64)
    vectors[3, 25] = 0.5
    a = operators.Matrix(dense(entries, 40).detach(), nullspace=vectors)
    with pytest.raises(ValueError, match="vector 3 of nullspace is not in the null space of A"):
        prdp.linear_solve(a, torch.zeros(40, dtype=torch.float64), prdp.CG(2))


@pytest.mark.parametrize("restart", [10, 30, 60])
def test_gmres_fails_where_a_null_vector_is_missing(restart):
    """Three graphs, of which the constant alone is named: b has no part outside the range, its cotangent has."""
    generator = torch.Generator().manual_seed(0)
    weights = torch.block_diag(*[torch.rand(20, 20, dtype=F64, generator=generator) for _ in range(3)])
    weights = (weights + weights.mT).fill_diagonal_(0)
    laplacian = torch.diag(weights.sum(1)) - weights
    b = torch.randn(1, 3, 20, dtype=F64, generator=generator)
    b = (b - b.mean(2, keepdim=True)).flatten(1).requires_grad_()
    a = operators.Matrix(laplacian, nullspace="constant")
    solver = prdp.GMRES(500, 1e-12, restart=restart)
    u, info = prdp.linear_solve(a, b, solver)
    assert info.solved.all()
    torch.testing.assert_close(u.mT, torch.linalg.pinv(laplacian, hermitian=True) @ b.mT, rtol=0, atol=1e-9)
    with pytest.raises(torch.linalg.LinAlgError, match=r"adjoint solve: 1 of 1 samples failed: sample 0 BREAKDOWN"):
        (u**3).sum().backward()
    u, info = prdp.linear_solve(a, b, solver, on_failure="zero_grad")
    (u**3).sum().backward()
    assert (b.grad == 0).all() and info.adjoint.failed.all()


@pytest.mark.parametrize("seed", range(4))
def test_bicgstab_fails_where_u_grows_along_a_null_vector(seed):
    generator = torch.Generator().manual_seed(seed + 4)
    a = 3 * torch.eye(30, dtype=F64) + 0.5 * torch.randn(30, 30, dtype=F64, generator=generator)
    q = torch.nn.functional.normalize(torch.randn(30, dtype=F64, generator=generator), dim=0)
    a = a - torch.outer(a @ q, q)
    b = torch.randn(3, 30, dtype=F64, generator=generator)
    u, info = prdp.linear_solve(a, b, prdp.BiCGStab(100, 1e-8), on_failure="return")
    grown = u.norm(dim=1) > 1e13
    assert not (grown & ~info.failed).any() and not info.solved.any()
