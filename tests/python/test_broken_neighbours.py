"""Gradients of a batch with a broken sample, where A or its preconditioner is the user's own: those of the healthy
samples alone."""

import pytest
import torch
from helpers import field, modes, statuses

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
HEALTHY = torch.tensor([0, 2])
NAN = float("nan")
N = 12


def ring(v, c, s):
    """A v = s v + c s (2 v - its neighbours), of which c is shared and s is the sample's."""
    return s * (v + c * (2 * v - v.roll(1, -1) - v.roll(-1, -1)))


def ring_diagonal(c, s):
    return (s * (1 + 2 * c)).expand(-1, N)


def function(c, s):
    return operators.Function(ring, tensors=(c, s), diagonal=ring_diagonal)


def heat(c, s):
    return operators.Heat((N,), c, 0.1)


def matrix(c, s):
    shift = torch.eye(N, dtype=F64).roll(1, 0)
    return operators.Matrix(torch.diag_embed(s.expand(-1, N)) * 3 + c * (shift + shift.mT))


OWN = operators.Function(lambda r: 0.5 * r)


def own_of_samples(s):
    return operators.Function(lambda r, s: r / s.view(-1, *[1] * (r.dim() - 1)), tensors=(s.detach(),))


def numbers(what):
    """b, s and the tensor of a preconditioner, each of three samples, of which the second is broken."""
    b, s, m = field((N,), batch=3, seed=1), torch.tensor([[1.0], [1.5], [2.0]], dtype=F64), torch.ones(3, 1, dtype=F64)
    broken = {"b": b, "A": s, "preconditioner": m}[what]
    broken[1, -1] = NAN
    return b, s, m


def derivatives(make, solver, b, s, backward, on_failure, second=False):
    """Of a loss that weighs every number: for c, b and s, and of their norms for c."""
    c, b, s = torch.tensor(0.4, dtype=F64, requires_grad=True), b.clone().requires_grad_(), s.clone().requires_grad_()
    vectors = b if make is heat else b[:, 0]
    u, info = prdp.linear_solve(make(c, s), vectors, solver, backward=backward, on_failure=on_failure)
    weights = torch.linspace(1, 20, N, dtype=F64).sin()
    found = torch.autograd.grad((u.tanh() * weights).sum(), (c, b, s), create_graph=second, allow_unused=True)
    if second:
        healthy = HEALTHY if len(b) == 3 else slice(None)
        return info, torch.autograd.grad(found[0] + found[1][healthy].square().sum(), c)
    return info, found


SOLVERS = {
    "CG": lambda m: prdp.CG(4, rtol=1e-3, preconditioner=m),
    "MINRES": lambda m: prdp.MINRES(4, rtol=1e-3, preconditioner=m),
    "GMRES": lambda m: prdp.GMRES(max_iter=2, restart=3, rtol=1e-3, preconditioner=m),
    "BiCGStab": lambda m: prdp.BiCGStab(3, rtol=1e-2, preconditioner=m),
}


@modes
@pytest.mark.parametrize("on_failure", ["zero_grad", "return"])
@pytest.mark.parametrize("method", SOLVERS)
@pytest.mark.parametrize("make, own, what", [
    (function, None, "b"), (function, None, "A"), (function, OWN, "A"), (function, own_of_samples, "preconditioner"),
    (heat, OWN, "b"), (heat, own_of_samples, "preconditioner"), (matrix, OWN, "b"), (matrix, OWN, "A"),
])  # fmt: skip
def test_a_broken_sample_takes_nothing_from_the_others(make, own, what, method, on_failure, backward):
    b, s, m = numbers(what)
    of = SOLVERS[method]
    solver, alone = (of(own_of_samples(m)), of(own_of_samples(m[HEALTHY]))) if own is own_of_samples else (of(own),) * 2
    for second in (False, True):
        info, found = derivatives(make, solver, b, s, backward, on_failure, second)
        assert info.failed.tolist() == [False, True, False], statuses(info)
        _, expected = derivatives(make, alone, b[HEALTHY], s[HEALTHY], backward, "raise", second)
        for mine, other in zip(found, expected, strict=True):
            if mine is None:
                assert other is None
                continue
            torch.testing.assert_close(mine if mine.dim() == 0 else mine[HEALTHY], other, rtol=1e-9, atol=1e-12)
            assert mine.dim() == 0 or not mine[1].any()


@pytest.mark.parametrize("solver", [prdp.Jacobi(6, rtol=0), prdp.SteepestDescent(5, rtol=0), prdp.Direct()])
@pytest.mark.parametrize("what", ["b", "A"])
def test_nor_with_methods_that_take_no_preconditioner(solver, what):
    b, s, _ = numbers(what)
    _, found = derivatives(function, solver, b, s, "unrolled", "zero_grad")
    _, expected = derivatives(function, solver, b[HEALTHY], s[HEALTHY], "unrolled", "raise")
    torch.testing.assert_close(found[0], expected[0], rtol=1e-9, atol=0.0)
    assert expected[0].abs() > 1e-3


def test_nor_in_forward_mode():
    b, s, _ = numbers("b")
    c = torch.tensor(0.4, dtype=F64)

    def solve(c, b, s):
        solver = prdp.GMRES(max_iter=2, restart=3)
        return prdp.linear_solve(function(c, s), b, solver, backward="unrolled", on_failure="zero_grad")[0]

    tangent = torch.func.jvp(lambda c: solve(c, b[:, 0], s), (c,), (torch.ones_like(c),))[1]
    alone = torch.func.jvp(lambda c: solve(c, b[HEALTHY, 0], s[HEALTHY]), (c,), (torch.ones_like(c),))[1]
    torch.testing.assert_close(tangent[HEALTHY], alone, rtol=1e-9, atol=1e-12)
    assert alone.abs().max() > 1e-3 and not tangent[1].any()


def test_tensors_that_all_samples_share_stay_as_they_are_where_their_first_extent_is_the_batch():
    """Shared weights of three, a tensor for the diagonal alone, and null vectors, in a batch of as many; sample 1 has a
    right-hand side of zero, or NaN in a tensor of its own."""
    b, s, _ = numbers("A")
    weights = torch.tensor([0.3, -0.2, 0.5], dtype=F64)

    def gradient(b, s, rows=slice(None)):
        c = weights.clone().requires_grad_()
        A = operators.Function(
            lambda v, c, s: s * v + c.exp().sum() * (2 * v - v.roll(1, -1) - v.roll(-1, -1)), tensors=(c, s)
        )
        for backward in ("unrolled", "implicit"):
            u, _ = prdp.linear_solve(A, b, prdp.BiCGStab(3, rtol=0), backward=backward, on_failure="zero_grad")
            yield torch.autograd.grad(u[rows].square().sum(), c)[0]

    for mine, expected in zip(gradient(b[:, 0], s), gradient(b[HEALTHY, 0], s[HEALTHY]), strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-9, atol=1e-12)

    b[1], d = 0.0, torch.linspace(2, 3, N, dtype=F64)
    batch = torch.arange(N).view(N, 1) % 3
    many = b[:, 0][batch[:, 0]]  # as many samples as unknowns

    def of_diagonal(b, solver):
        c = torch.tensor(0.3, dtype=F64, requires_grad=True)
        A = operators.Function(
            lambda v, c, d: torch.linspace(2, 3, N, dtype=F64) * v + c * v.roll(1, -1),
            tensors=(c, d),
            diagonal=lambda c, d: d,
        )
        u, _ = prdp.linear_solve(A, b, solver, backward="unrolled", on_failure="return")
        return torch.autograd.grad(u.square().sum(), c)[0]

    for solver in (prdp.Jacobi(3, rtol=0), prdp.BiCGStab(2, rtol=0), prdp.GMRES(max_iter=1, restart=3, rtol=0)):
        torch.testing.assert_close(of_diagonal(many, solver), of_diagonal(many[batch[:, 0] != 1], solver))

    Z = torch.zeros(2, N, dtype=F64)
    Z[0, : N // 2], Z[1, N // 2 :] = 1.0, 1.0

    def two_rings(v, c):
        halves = v.unflatten(-1, (2, N // 2))
        return c * (2 * halves - halves.roll(1, -1) - halves.roll(-1, -1)).flatten(-2)

    c = torch.tensor(0.7, dtype=F64, requires_grad=True)
    A = operators.Function(two_rings, tensors=(c,), nullspace=Z)
    f = b[:2, 0] - b[:2, 0] @ Z.mT @ Z / (N // 2)
    for solver in (prdp.BiCGStab(2, rtol=0), prdp.GMRES(max_iter=1, restart=3, rtol=0)):
        both, alone = (
            torch.autograd.grad(prdp.linear_solve(A, of, solver, backward="unrolled")[0].square().sum(), c)[0]
            for of in (f, f[:1])
        )
        torch.testing.assert_close(both, alone)
