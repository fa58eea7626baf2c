"""`Direct` with factors that a batch shares: samples are solved together, each as it is alone."""

import pytest
import torch
from helpers import statuses

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def random(*shape, seed=0):
    return torch.rand(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def chain(n=23, shift=0.1):
    """A graph with random weights, plus the shift times the identity."""
    a = torch.zeros(n, n, dtype=F64)
    ends = torch.randint(n, (2, 3 * n), generator=torch.Generator().manual_seed(1))
    for i, j, weight in zip(*ends, random(3 * n), strict=True):
        a[i, i] += weight
        a[j, j] += weight
        a[i, j] -= weight
        a[j, i] -= weight
    return a + shift * torch.eye(n, dtype=F64)


def csr(sign=1, above=0):
    def make(dtype):
        return operators.Matrix((sign * chain() + above * torch.diag(random(22), 1)).to(dtype).to_sparse_csr()), (23,)

    return make


def diffusion(channels, **settings):
    def make(dtype):
        return operators.Diffusion((0.1 + random(1, 5, 4)).to(dtype), **settings), (channels, 5, 4)

    return make


def dense(n):
    def make(dtype):
        return operators.Matrix((random(n, n, seed=7) + n / 4 * torch.eye(n, dtype=F64)).to(dtype)), (n,)

    return make


def beam(boundary):
    def make(dtype):
        rows = torch.tensor([7.0, -4.0, -4.0, 1.0, 1.0], dtype=F64).view(1, 5, 1) + 0.1 * random(1, 5, 31)
        return operators.Stencil(rows.to(dtype), [(0,), (-1,), (1,), (-2,), (2,)], boundary), (2, 31)

    return make


CASES = {
    "csr": csr(),
    "negative csr": csr(sign=-1),
    "unsymmetric csr": csr(above=1),
    "dense": dense(23),
    "large dense": dense(203),
    "beam": beam("zero"),
    "ring of beams": beam("periodic"),
    "diffusion": diffusion(2, shift=0.1),
    "closed diffusion": diffusion(3, boundary="flux"),
}


def rhs_of(case, batch, shape, seed):
    b = random(batch, *shape, seed=seed) - 0.5
    return b - b.mean((2, 3), keepdim=True) if case.startswith("closed") else b


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("batch", [2, 7, 8, 9, 21])
def test_samples_have_the_bits_that_they_have_alone(case, batch, dtype):
    a, shape = CASES[case](dtype)
    b = rhs_of(case, batch, shape, seed=2).to(dtype)
    b[::4] *= 1e-20  # each is scaled by its own power of two
    u, info = prdp.linear_solve(a, b, prdp.Direct())
    alone = [prdp.linear_solve(a, b[s : s + 1], prdp.Direct()) for s in range(batch)]
    assert u.equal(torch.cat([of[0] for of in alone]))
    assert info.residual.equal(torch.cat([of[1].residual for of in alone]))
    matrix = a.dense().double().view(-1, *a.dense().shape[-2:])[0]
    vectors = b.double().reshape(-1, matrix.shape[-1]).T
    exact = (torch.linalg.pinv(matrix, rtol=1e-6) @ vectors).T.reshape(b.shape)
    error = (u - exact).flatten(1).norm(dim=1) / exact.flatten(1).norm(dim=1)
    assert error.max() < (1e-12 if dtype == F64 else 1e-6)


@pytest.mark.parametrize("case", CASES)
def test_a_sample_that_is_not_solved_spoils_no_other(case):
    a, shape = CASES[case](F64)
    b = rhs_of(case, 11, shape, seed=3)
    whole, _ = prdp.linear_solve(a, b, prdp.Direct())
    bad = b.clone()
    bad[0, ..., 0], bad[4], bad[9] = torch.nan, 0.0, b[8]
    u, info = prdp.linear_solve(a, bad, prdp.Direct(), on_failure="return")
    assert statuses(info) == ["NONFINITE_INPUT", *["CONVERGED"] * 10]
    others = [1, 2, 3, 5, 6, 7, 8, 10]
    assert u[others].equal(whole[others]) and u[9].equal(whole[8]) and not u[[0, 4]].any()
    assert info.iterations.tolist() == [0, 1, 1, 1, 0, 1, 1, 1, 1, 1, 1]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_gradients_and_refinements_do_not_depend_on_the_batch(case, threads):
    """rtol = 0 asks for a second iteration, whose right-hand side nobody knows beforehand."""
    a, shape = CASES[case](F64)
    b, cotangent = (rhs_of(case, 10, shape, seed) for seed in (4, 5))
    solver = prdp.Direct(max_iter=2, rtol=0.0)

    def solve(b, cotangent):
        leaf = b.clone().requires_grad_()
        u, _ = prdp.linear_solve(a, leaf, solver)
        return u.detach(), torch.autograd.grad(u, leaf, cotangent)[0]

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        together = solve(b, cotangent)
    finally:
        torch.set_num_threads(before)
    alone = [solve(b[s : s + 1], cotangent[s : s + 1]) for s in range(10)]
    for found, expected in zip(together, zip(*alone, strict=True), strict=True):
        assert found.equal(torch.cat(expected))


def test_unsymmetric_pins_of_a_singular_matrix():
    """Its null vector and that of its transpose are largest at different unknowns."""
    left, right = torch.linspace(1, 2, 12, dtype=F64), torch.linspace(3, 1, 12, dtype=F64)
    a = torch.diag(1 / left) @ (chain(12, shift=0.0)) @ torch.diag(1 / right)
    wrapped = operators.Matrix(a.to_sparse_csr(), nullspace=right[None], left_nullspace=left[None])
    b = random(9, 12, seed=6) @ a.T
    u, info = prdp.linear_solve(wrapped, b, prdp.Direct())
    assert info.solved.all()
    torch.testing.assert_close(u, b @ torch.linalg.pinv(a).T, rtol=1e-9, atol=1e-11)
