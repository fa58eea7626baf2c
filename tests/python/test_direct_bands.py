"""`Direct` on narrow bands, as of one dimension: LU with partial pivoting, periodic ones folded. Beside LAPACK."""

import pytest
import torch
from helpers import random
from hypothesis import given, settings
from hypothesis import strategies as st

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def banded(n, below, above, periodic=False, seed=0, diagonal=0.0):
    """A dense matrix with normal numbers in its band, which wraps around if it is periodic."""
    a = torch.zeros(n, n, dtype=F64)
    values = torch.randn(below + above + 1, n, dtype=F64, generator=torch.Generator().manual_seed(seed))
    for k, row in zip(range(-below, above + 1), values, strict=True):
        for i in range(n):
            if periodic or 0 <= i + k < n:
                a[i, (i + k) % n] += row[i]
    return a + diagonal * torch.eye(n, dtype=F64)


def check(a, b, dtype=F64, tolerance=1e-12):
    """u and both gradients beside LAPACK's, to the condition of A."""
    sparse = a.to(dtype).to_sparse_csr()
    values = sparse.values().clone().requires_grad_()
    given = operators.Matrix.csr(sparse.crow_indices(), sparse.col_indices(), values, len(a))
    leaf = b.to(dtype).requires_grad_()
    u, info = prdp.linear_solve(given, leaf, prdp.Direct())
    weights = random(*b.shape, seed=9)
    by_b, by_a = torch.autograd.grad((u * weights.to(dtype)).sum(), (leaf, values))
    exact = torch.linalg.solve(a, b.mT).mT
    adjoint = torch.linalg.solve(a.mT, weights.mT).mT
    where = sparse.to_sparse_coo().indices()
    of_values = -(adjoint.mT @ exact)[where[0], where[1]]
    bound = tolerance * max(torch.linalg.cond(a).item(), 1.0)
    for found, true in ((u, exact), (by_b, adjoint), (by_a, of_values)):
        assert (found - true).norm() <= bound * true.norm()
    return info


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize(
    "below, above", [(0, 1), (1, 1), (2, 0), (2, 2), (1, 3), (3, 3), (4, 4), (5, 8), (8, 8), (9, 9)]
)
@pytest.mark.parametrize("n", [19, 20, 64])
def test_u_and_gradients_are_those_of_lapack(n, below, above, periodic):
    a = banded(n, below, above, periodic, seed=n)
    if torch.linalg.cond(a) > 1e8:
        a = banded(n, below, above, periodic, seed=n, diagonal=2.0)
    info = check(a, random(9, n, seed=1))
    assert (info.status == prdp.SolveStatus.CONVERGED).all() and info.residual.max() < 1e-9


@settings(deadline=None, max_examples=60)
@given(
    n=st.integers(1, 40),
    below=st.integers(0, 6),
    above=st.integers(0, 6),
    periodic=st.booleans(),
    seed=st.integers(0, 10**6),
    batch=st.integers(1, 17),
)
def test_any_band(n, below, above, periodic, seed, batch):
    a = banded(n, below, above, periodic, seed, diagonal=3.0)
    if torch.linalg.cond(a) < 1e6:
        check(a, random(batch, n, seed=2))


def test_pivots_are_exchanged():
    """Zeros all along the diagonal, and one row that is far larger."""
    n = 30
    a = banded(n, 2, 2, seed=3)
    a.fill_diagonal_(0.0)
    a[7] *= 1e6
    check(a, random(2, n, seed=1))


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 1e-6), (F64, 1e-12)])
@pytest.mark.parametrize("boundary", ["zero", "periodic"])
def test_a_beam_of_each_sample(boundary, dtype, tolerance):
    n, offsets = 48, [(0,), (-1,), (1,), (-2,), (2,)]
    stiffness = 1 + torch.rand(3, 1, n, dtype=F64, generator=torch.Generator().manual_seed(0))
    rows = stiffness * torch.tensor([7.0, -4.0, -4.0, 1.0, 1.0], dtype=F64).view(1, 5, 1)
    a, b = operators.Stencil(rows.to(dtype), offsets, boundary), random(3, 1, n, seed=1)
    dense = operators.Stencil(rows, offsets, boundary).dense(F64)
    exact = torch.linalg.solve(dense, b.view(3, n, 1)).view_as(b)
    u, info = prdp.linear_solve(a, b.to(dtype), prdp.Direct())
    assert info.solved.all() and ((u - exact).abs() < 200 * tolerance * exact.abs().max()).all()
    alone, _ = prdp.linear_solve(
        operators.Stencil(rows[1:2].to(dtype), offsets, boundary), b[1:2].to(dtype), prdp.Direct()
    )
    assert torch.equal(alone, u[1:2])


@pytest.mark.parametrize("transposed", [False, True])
def test_a_sample_has_the_bits_that_it_has_alone(transposed):
    a, b = banded(50, 3, 2, periodic=True, seed=5), random(21, 50, seed=1)
    a = (a.mT if transposed else a).contiguous().to_sparse_csr()
    together, _ = prdp.linear_solve(a, b, prdp.Direct())
    for i in range(21):
        assert torch.equal(prdp.linear_solve(a, b[i : i + 1], prdp.Direct())[0][0], together[i])


def test_a_singular_band_breaks_down_and_a_badly_scaled_one_does_not():
    a, b = banded(20, 1, 2, seed=1, diagonal=4.0), random(2, 20, seed=1)
    scales = torch.logspace(-9, 9, 20, dtype=F64)
    exact = torch.linalg.solve(a, b.mT).mT
    u, info = prdp.linear_solve((scales[:, None] * a).to_sparse_csr(), b * scales, prdp.Direct())
    assert info.solved.all() and (u - exact).norm() < 1e-9 * exact.norm()
    a[:, 5] = 0.0
    _, info = prdp.linear_solve(a.to_sparse_csr(), b, prdp.Direct(), on_failure="return")
    assert (info.status == prdp.SolveStatus.BREAKDOWN).all()


def test_a_null_space_that_is_named_is_left_out():
    n = 33
    rows = torch.tensor([6.0, -4.0, -4.0, 1.0, 1.0], dtype=F64).view(1, 5, 1).expand(1, 5, n).contiguous()
    a = operators.Stencil(rows, [(0,), (-1,), (1,), (-2,), (2,)], "periodic", nullspace="constant")
    b = random(4, 1, n, seed=2)
    b = b - b.mean(-1, keepdim=True)
    u, info = prdp.linear_solve(a, b, prdp.Direct())
    dense = a.dense(F64).view(n, n)
    exact = (torch.linalg.pinv(dense, rtol=1e-10) @ b.view(4, n).mT).mT.view(4, 1, n)
    assert info.solved.all() and (u - exact).norm() < 1e-8 * exact.norm()


def test_entries_at_one_place_are_added():
    crow, col = torch.tensor([0, 3, 5]), torch.tensor([0, 0, 1, 1, 0])
    a = operators.Matrix.csr(crow, col, torch.tensor([1.0, 2.0, 1.0, 4.0, 1.0], dtype=F64), 2)
    u, _ = prdp.linear_solve(a, torch.tensor([[1.0, 2.0]], dtype=F64), prdp.Direct())
    torch.testing.assert_close(
        u, torch.linalg.solve(torch.tensor([[3.0, 1], [1, 4]]).double(), torch.tensor([1.0, 2]).double())[None]
    )
