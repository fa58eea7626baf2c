"""Operators without kernels on the CPU: their vectors go through the loops of the processor, not through tensor
operations, where they fill whole registers."""

import collections

import pytest
import torch
from helpers import statuses
from torch.utils._python_dispatch import TorchDispatchMode

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64
OFFSETS = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
METHODS = {
    "cg": lambda k: prdp.CG(k, 0.0),
    "cg diagonal": lambda k: prdp.CG(k, 0.0, preconditioner="diagonal"),
    "steepest descent": lambda k: prdp.SteepestDescent(k, 0.0),
    "bicgstab": lambda k: prdp.BiCGStab(k, 0.0),
    "gmres": lambda k: prdp.GMRES(k, 0.0, restart=5),
    "jacobi": lambda k: prdp.Jacobi(k, 0.0),
}


def product(v):
    w = 4.3 * v
    for axis in (-1, -2):
        w = w - v.roll(1, axis) - v.roll(-1, axis)
    return w


def function(matvec=product):
    return operators.Function(matvec, symmetric=True, diagonal=lambda: torch.tensor(4.3, dtype=F64))


def stencil(shape, dtype):
    coefficients = torch.full((1, 5, *shape), -1.0, dtype=dtype)
    coefficients[:, 0] = 4.3
    return operators.Stencil(coefficients, OFFSETS, "periodic")


def noise(shape, batch=3, dtype=F64):
    return torch.randn(batch, 1, *shape, dtype=dtype, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("shape", [(8, 16), (7, 9), (96, 96)], ids=str)  # odd vectors; sums over blocks
@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("method", METHODS)
def test_iterates_and_gradients_are_those_of_the_kernels(method, dtype, shape):
    answers = []
    for a in (function(), stencil(shape, dtype)):
        b = noise(shape, dtype=dtype).requires_grad_()
        u, info = prdp.linear_solve(a, b, METHODS[method](4))
        (gradient,) = torch.autograd.grad(u, b, b.detach().square())
        answers.append((u, gradient, info.operator_applications))
    for mine, other in zip(*answers, strict=True):
        assert torch.allclose(mine, other, rtol=1e-4 if dtype == F32 else 1e-10, atol=1e-5 if dtype == F32 else 1e-11)


@pytest.mark.parametrize("method", METHODS)
def test_a_sample_that_ends_early_keeps_its_values(method):
    b = noise((8, 16))
    b[1] = 0.0
    b[2] = product(torch.ones(8, 16, dtype=F64)) * 0.3  # an eigenvector: one iteration
    solver = METHODS[method](300)
    solver.rtol = 1e-9
    u, info = prdp.linear_solve(function(), b, solver)
    assert all(name.startswith("CONVERGED") for name in statuses(info)) and len(set(info.iterations.tolist())) > 1
    for i in range(3):
        alone, of_it = prdp.linear_solve(function(), b[i : i + 1], solver)
        assert torch.allclose(alone[0], u[i], rtol=1e-12, atol=1e-12) and of_it.iterations[0] == info.iterations[i]


@pytest.mark.parametrize("method", METHODS)
def test_a_product_may_keep_what_it_was_given(method):
    kept = []

    def keeping(v):
        kept.append((v, v.clone()))
        return product(v)

    prdp.linear_solve(function(keeping), noise((8, 16)), METHODS[method](5))
    assert len(kept) > 4 and all(torch.equal(*pair) for pair in kept)


@pytest.mark.parametrize("method", METHODS)
def test_a_product_may_return_what_it_keeps_or_was_given(method):
    """The identity, and twice the identity in memory of its own, which must not change."""
    twice = {}

    def doubled(v):
        twice["last"] = 2 * v
        twice["copy"] = twice["last"].clone()
        return twice["last"]

    b = noise((8, 16))
    u, _ = prdp.linear_solve(operators.Function(lambda v: v, symmetric=True, diagonal=lambda: torch.tensor(1.0)), b,
                             METHODS[method](2))  # fmt: skip
    assert torch.allclose(u, b)
    u, _ = prdp.linear_solve(operators.Function(doubled, symmetric=True, diagonal=lambda: torch.tensor(2.0)), b,
                             METHODS[method](2))  # fmt: skip
    assert torch.allclose(u, b / 2) and torch.equal(twice["last"], twice["copy"])


def test_vectors_in_another_order_of_memory():
    """The product returns its vector with the axes in another order."""

    def turned(v):
        return product(v.mT.contiguous()).mT

    b = noise((8, 16))
    u, _ = prdp.linear_solve(function(turned), b, prdp.CG(6, 0.0))
    assert torch.allclose(u, prdp.linear_solve(function(), b, prdp.CG(6, 0.0))[0], rtol=1e-12, atol=1e-12)


class Operations(TorchDispatchMode):
    """Counts the operations between its entry and its exit, but for new memory."""

    def __init__(self):
        super().__init__()
        self.counts = collections.Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function._schema.name.removeprefix("aten::")
        self.counts[name] += name not in ("empty", "empty_like", "zeros_like", "detach", "alias")
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("method, at_most, products", [("cg", 4, 1), ("steepest descent", 4, 1), ("bicgstab", 24, 2)])
def test_operations_of_an_iteration_beside_its_products(method, at_most, products):
    """Those between call 10 of the product and the one that ends the iteration."""
    operations, calls = Operations(), [0]

    def watched(v):
        if 10 <= calls[0] < 10 + products:
            operations.__exit__(None, None, None)
        calls[0] += 1
        w = product(v)
        if 10 <= calls[0] < 10 + products:
            operations.__enter__()
        return w

    prdp.linear_solve(function(watched), noise((8, 16)), METHODS[method](20))
    assert calls[0] > 12 and sum(operations.counts.values()) <= at_most, operations.counts
