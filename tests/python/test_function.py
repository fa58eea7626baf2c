"""Operators of one's own, by their products."""

import gc
import weakref

import numpy as np
import pytest
import torch
from helpers import statuses

import prdp_torch as prdp
from prdp_torch import operators

N = 4


def shifted(v, k, s):
    """(2 + k²) v_i - s v_{i-1} on a ring: nonsymmetric; k may differ between samples."""
    return (2 + k**2) * v - s * v.roll(1, -1)


def shifted_transpose(v, k, s):
    return (2 + k**2) * v - s * v.roll(-1, -1)


def tensors(dtype=torch.float64):
    k = torch.tensor([[0.3], [0.5], [-0.2]], dtype=dtype)
    return k, torch.tensor(0.7, dtype=dtype)


def dense(k, s):
    eye = torch.eye(N, dtype=torch.float64)
    return (2 + k[:, :, None].double() ** 2) * eye - s.double() * eye.roll(1, 0)


def right_hand_side(dtype=torch.float64):
    return torch.randn(3, N, dtype=dtype, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("dtype, rtol, close", [(torch.float64, 1e-12, 1e-10), (torch.float32, 1e-6, 1e-5)])
@pytest.mark.parametrize("solver", [prdp.GMRES, prdp.SteepestDescent, prdp.Direct])
def test_solutions_equal_the_dense_ones(solver, dtype, rtol, close):
    k, s = tensors(dtype)
    a, b = operators.Function(shifted, shifted_transpose, (k, s)), right_hand_side(dtype)
    u, info = prdp.linear_solve(a, b, solver(500, rtol=rtol))
    assert (info.status > 0).all()
    np.testing.assert_allclose(u, torch.linalg.solve(dense(k, s), b.double()), atol=close)
    np.testing.assert_allclose(a.apply(u), b, atol=10 * close)
    np.testing.assert_allclose(a.apply_transpose(b), (dense(k, s).mT @ b.double()[..., None])[..., 0], atol=close)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", [prdp.GMRES(3, restart=6, rtol=0.0), prdp.Direct()], ids=["gmres", "direct"])
def test_derivatives(solver, backward):
    k, s = (t.requires_grad_() for t in tensors())
    b = right_hand_side().requires_grad_()

    def solve(b, k, s):
        return prdp.linear_solve(operators.Function(shifted, shifted_transpose, (k, s)), b, solver, backward=backward)[
            0
        ]

    assert torch.autograd.gradcheck(solve, (b, k, s))
    assert torch.autograd.gradgradcheck(solve, (b, k, s))


def test_the_backward_pass_keeps_the_operator_alive():
    k, s = (t.requires_grad_() for t in tensors())
    a = operators.Function(shifted, shifted_transpose, (k, s))
    u, _ = prdp.linear_solve(a, right_hand_side(), prdp.GMRES(5))
    del a
    gc.collect()
    u.sum().backward()
    assert k.grad.abs().min() > 0 and s.grad.abs() > 0


class Owner:
    """Keeps an operator whose products are its own methods."""

    def __init__(self):
        self.scale = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
        self.operator = operators.Function(self.times, self.times, (self.scale,))

    def times(self, v, scale):
        return scale * v


def test_an_operator_in_a_cycle_with_its_owner_is_freed():
    owner = Owner()
    alive = weakref.ref(owner)
    u, _ = prdp.linear_solve(owner.operator, right_hand_side(), prdp.CG(3))
    scale = owner.scale
    del owner
    gc.collect()
    assert alive() is not None  # the backward pass needs it
    u.sum().backward()
    torch.testing.assert_close(scale.grad, -right_hand_side().sum() / 4)
    del u
    gc.collect()
    assert alive() is None


def test_an_operator_that_is_in_use_is_not_taken_for_garbage():
    owner = Owner()
    operator, alive = owner.operator, weakref.ref(owner)
    del owner
    gc.collect()
    assert alive() is not None and torch.equal(operator.apply(torch.ones(1, 2)), torch.full((1, 2), 2.0))


def test_a_symmetric_operator_on_fields_takes_the_same_product_twice():
    def laplacian(v):
        return 2.5 * v - torch.nn.functional.pad(v, (1, 0))[..., :-1] - torch.nn.functional.pad(v, (0, 1))[..., 1:]

    b = torch.randn(2, 1, 4, 9, dtype=torch.float64)
    u, info = prdp.linear_solve(operators.Function(laplacian, laplacian), b, prdp.CG(100, rtol=1e-12))
    assert (info.status > 0).all()
    np.testing.assert_allclose(laplacian(u), b, atol=1e-10)


def test_nan_stays_with_its_sample():
    k, s = tensors()
    b = right_hand_side()
    alone, _ = prdp.linear_solve(operators.Function(shifted, shifted_transpose, (k[:1], s)), b[:1], prdp.GMRES(3))
    b[1, 2] = torch.nan
    a = operators.Function(shifted, shifted_transpose, (k, s))
    u, info = prdp.linear_solve(a, b, prdp.GMRES(3), on_failure="return")
    assert statuses(info)[1] == "NONFINITE_INPUT" and torch.isfinite(u).all()
    np.testing.assert_allclose(u[:1], alone, rtol=1e-14)


@pytest.mark.parametrize(
    "call, error, message",
    [
        (lambda: operators.Function("a", shifted), TypeError, "Function: matvec must be callable, got 'a'"),
        (lambda: operators.Function(shifted, shifted_transpose, (3.0,)), TypeError, "every tensor must be a torch"),
        (
            lambda: solve_with(lambda v: v[:, 1:]),
            ValueError,
            r"matvec must return what it was given, \[2, 4\] in Float",
        ),
        (lambda: solve_with(lambda v: v.double()), ValueError, "matvec must return what it was given"),
        (lambda: solve_with(lambda v: v, prdp.Jacobi(3)), ValueError, "its diagonal, which Jacobi divides by"),
        (lambda: solve_with(lambda v: v / (1 / 0)), ZeroDivisionError, "division by zero"),
    ],
)
def test_mistakes(call, error, message):
    with pytest.raises(error, match=message):
        call()


def solve_with(matvec, solver=None):
    return prdp.linear_solve(operators.Function(matvec, matvec), torch.ones(2, 4), solver or prdp.GMRES(3))
