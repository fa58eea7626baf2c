"""torch.utils.checkpoint around steps: the gradient is the same, and nothing is left behind."""

import gc
import warnings

import pytest
import torch
from helpers import random
from torch.utils.checkpoint import checkpoint

import prdp_torch as prdp

STEPS = 5


def a_of_u(u):
    return prdp.operators.Diffusion(1 + u[:, 0] ** 2, shift=1.0)


CASES = {
    "flow": (lambda: prdp.Flow((6, 7), nu=1e-2, dt=1e-2), (2, 2, 6, 7)),
    "flow, return": (lambda: prdp.Flow((6, 7), nu=1e-2, dt=1e-2, on_failure="return"), (2, 2, 6, 7)),
    "unrolled": (lambda: prdp.Heat((9,), 1e-2, 1.0, solver=prdp.CG(4, rtol=0.0), backward="unrolled"), (2, 1, 9)),
    "burgers": (lambda: prdp.Burgers((9,), 1e-2, 0.1, solver=prdp.GMRES(4)), (2, 1, 9)),
    "own": (lambda: prdp.ImplicitStep(a_of_u, solver=prdp.CG(50)), (2, 1, 9)),
}


def living(shape):
    """The tensors of this shape that anybody holds."""
    gc.collect()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some modules warn where their attributes are looked at
        return sum(isinstance(o, torch.Tensor) and o.shape == shape for o in gc.get_objects())


@pytest.mark.parametrize("reused", [False, True])
@pytest.mark.parametrize("method", [prdp.GMRES, prdp.CG, prdp.BiCGStab])
def test_a_function_may_be_looked_at_in_one_of_the_two_passes_alone(method, reused):
    """Its product is recorded to look at it in the 1st, 2nd, 4th, … solve: torch counts the tensors that are saved."""
    a, b = torch.rand(1, 5, requires_grad=True), torch.randn(2, 1, 5, requires_grad=True)

    def product(v, a):
        return (2 + a.exp()) * v

    kept = prdp.operators.Function(product, product, tensors=[a])

    def solve(a, b):
        of = kept if reused else prdp.operators.Function(product, product, tensors=[a])
        return prdp.linear_solve(of, b, method(20))[0]

    expected = torch.autograd.grad(solve(a, b).sum(), (a, b))
    for _ in range(20):
        found = torch.autograd.grad(checkpoint(solve, a, b, use_reentrant=False).sum(), (a, b))
        assert all(map(torch.equal, found, expected))


@pytest.mark.parametrize("use_reentrant", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_a_recomputed_rollout_leaves_nothing_behind(name, use_reentrant):
    make, shape = CASES[name]
    step, u = make(), 0.1 * random(*shape)
    states = torch.Size([shape[0], STEPS + 1, *shape[1:]])

    def rollout(v):
        return step.rollout(v, STEPS)[:, -1].clone()

    def gradient(recomputes):
        start = last = u.clone().requires_grad_()
        for _ in range(3):
            last = checkpoint(rollout, last, use_reentrant=use_reentrant) if recomputes else rollout(last)
        last.square().sum().backward()
        return start.grad

    expected, before = gradient(False), living(states)
    for _ in range(3):
        torch.testing.assert_close(gradient(True), expected, rtol=0, atol=0)
    assert living(states) == before
