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


def test_a_sample_beyond_the_range_of_unrolled_derivatives_loses_its_own():
    """Its A scales by 1e160, whose squares leave float64."""
    c = torch.tensor(0.5, dtype=F64, requires_grad=True)
    t = torch.tensor([[1.0], [1e160]], dtype=F64)
    A = operators.Function(lambda v, c, t: t * v + c * torch.linspace(0, 1, N, dtype=F64) * v, tensors=(c, t))
    b = field((N,), batch=2, seed=3)[:, 0]
    u, _ = prdp.linear_solve(A, b, prdp.BiCGStab(30, rtol=1e-6), backward="unrolled", on_failure="zero_grad")
    found = torch.autograd.grad(u[0].square().sum(), c)[0]
    d = torch.linspace(0, 1, N, dtype=F64)
    expected = (-2 * b[0].square() * d / (1 + c.detach() * d) ** 3).sum()
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=0.0)
