"""Matrices that several right-hand sides share: by an axis of one, and under vmap."""

import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
SOLVERS = [prdp.Direct(), prdp.GMRES(20, rtol=1e-12), prdp.BiCGStab(40, rtol=1e-13), prdp.Jacobi(200, rtol=1e-13)]


def matrices(*batch, n=7, seed=0):
    a = torch.randn(*batch, n, n, dtype=F64, generator=torch.Generator().manual_seed(seed))
    return (a + 8 * torch.eye(n, dtype=F64)).requires_grad_()


def rhs(*shape, seed=1):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).requires_grad_()


def as_csr(a):
    """A with all its entries as a pattern: crow, col and values, (n²,) or (batch, n²)."""
    n = a.shape[-1]
    return torch.arange(0, n * n + 1, n), torch.arange(n).repeat(n), a.flatten(-2)


def dense(a):
    return operators.Matrix(a)


def csr(a):
    return operators.Matrix.csr(*as_csr(a), size=a.shape)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("make", [dense, csr])
@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)
def test_a_batch_of_one_matrix_is_that_of_all_samples(solver, make, backward):
    if isinstance(solver, prdp.Direct):
        backward = "implicit"
    a, b, cotangent = matrices(1), rhs(4, 7), rhs(4, 7, seed=2).detach()
    u = prdp.linear_solve(make(a), b, solver, backward=backward)[0]
    one = prdp.linear_solve(make(a[0]), b, solver, backward=backward)[0]
    assert u.equal(one)
    found, expected = (torch.autograd.grad(v, (a, b), cotangent) for v in (u, one))
    assert found[0].shape == (1, 7, 7) and all(g.equal(h) for g, h in zip(found, expected, strict=True))
    exact = torch.linalg.solve(a[0], b.T).T
    torch.testing.assert_close(u, exact, rtol=1e-9, atol=1e-10)
    for g, h in zip(found, torch.autograd.grad(exact, (a, b), cotangent), strict=True):
        torch.testing.assert_close(g, h, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("make", [dense, csr])
@pytest.mark.parametrize("samples, entries", [(1, 4), (3, 5), (5, 3)])
@pytest.mark.parametrize("solver", SOLVERS[:2], ids=lambda s: type(s).__name__)
def test_right_hand_sides_of_several_matrices_go_through_vmap(solver, samples, entries, make):
    a, b, cotangent = matrices(samples), rhs(samples, entries, 7), rhs(samples, entries, 7, seed=2).detach()

    def solved(b, x0):
        return prdp.linear_solve(make(a), b, solver, x0=x0)[0]

    start = b.detach() / 8
    u = torch.vmap(solved, in_dims=1, out_dims=1)(b, start)
    alone = torch.stack([solved(b[:, k], start[:, k]) for k in range(entries)], 1)
    assert u.equal(alone)
    exact = torch.linalg.solve(a, b.mT).mT
    torch.testing.assert_close(u, exact, rtol=1e-9, atol=1e-10)
    found, expected = (torch.autograd.grad(v, (a, b), cotangent) for v in (u, exact))
    for g, h in zip(found, expected, strict=True):
        torch.testing.assert_close(g, h, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("samples", [1, 2])
def test_fields_of_samples_go_through_vmap_with_b_alone(samples):
    kappa = (rhs(samples, 5, 6).exp()).detach().requires_grad_()
    b = rhs(4, samples, 1, 5, 6)

    def solved(b):
        return prdp.linear_solve(operators.Diffusion(kappa, shift=1.0), b, prdp.CG(60, rtol=1e-13))[0]

    u, alone = torch.vmap(solved)(b), torch.stack([solved(one) for one in b])
    torch.testing.assert_close(u, alone, rtol=1e-12, atol=1e-13)
    found, expected = (torch.autograd.grad(v.square().sum(), kappa)[0] for v in (u, alone))
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-11)


def test_products_take_a_lone_vector():
    a, v = matrices(), rhs(7).detach()
    for make in (dense, csr):
        torch.testing.assert_close(make(a).apply(v), a @ v)
        torch.testing.assert_close(make(a).apply_transpose(v), a.T @ v)
    with pytest.raises(
        ValueError,
        match=r"shape of a channel, \[7\]; or \(batch, k, n\); got \[7\]; give n.unsqueeze\(0\) for one vector n",
    ):
        prdp.linear_solve(operators.Matrix(a.detach(), nullspace=v), v, SOLVERS[1])


def test_a_failed_solve_among_them_is_told():
    a, b = matrices(2), rhs(2, 3, 7).detach()
    b[1, 2, 0] = torch.nan
    with pytest.raises(RuntimeError, match="NONFINITE_INPUT"):
        torch.vmap(lambda b: prdp.linear_solve(dense(a), b, SOLVERS[1])[0], in_dims=1)(b)
    status = torch.vmap(lambda b: prdp.linear_solve(dense(a), b, SOLVERS[1], on_failure="return")[1].status, 1)(b)
    assert status.shape == (3, 2) and status[2, 1] == prdp.SolveStatus.NONFINITE_INPUT
    assert (status > 0).sum() == 5
