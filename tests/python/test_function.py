"""Operators of one's own, by their products."""

import copy
import gc
import pickle
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


def test_what_rounding_leaves_of_an_operator_of_unknown_norm_is_no_failure():
    """I + U Vᵀ of condition 1e4 in float32: an iterate as exact as the dtype allows exhausts the space of GMRES."""
    n, generator = 200, torch.Generator().manual_seed(0)
    left, right = (torch.randn(n, 3, generator=generator) / n**0.5 for _ in "UV")
    a = operators.Function(lambda v, u, w: v + 300 * (v @ w) @ u.T, tensors=(left, right))
    b = torch.randn(8, n, generator=generator)
    u, info = prdp.linear_solve(a, b, prdp.GMRES(30))
    assert info.solved.all() and (info.status == prdp.SolveStatus.STAGNATED).any()
    matrix = torch.eye(n, dtype=torch.float64) + 300 * left.double() @ right.double().T
    truth = torch.linalg.solve(matrix, b.double().T).T
    assert ((u - truth).norm(dim=1) < 1e-4 * truth.norm(dim=1)).all()


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


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_tensor_with_nan_stays_with_its_sample(backward):
    """Not known beforehand is which sample a tensor belongs to: the products tell."""
    k, s = tensors()
    b, solver = right_hand_side(), prdp.GMRES(3)
    alone, _ = prdp.linear_solve(operators.Function(shifted, shifted_transpose, (k[:1], s)), b[:1], solver)
    k[1] = torch.nan
    a = operators.Function(shifted, shifted_transpose, (k, s.clone().requires_grad_()))
    u, info = prdp.linear_solve(a, b, solver, backward=backward, on_failure="return")
    assert statuses(info)[1] == "NONFINITE_OPERATOR" and torch.isfinite(u).all() and info.status[0] > -2
    np.testing.assert_allclose(u[:1].detach(), alone, rtol=1e-14)
    with pytest.raises(
        torch.linalg.LinAlgError, match=r"sample 1 NONFINITE_OPERATOR, GMRES\(10\) on Function: A is made"
    ):
        prdp.linear_solve(a, b, solver)


@pytest.mark.parametrize(
    "call, error, message",
    [
        (lambda: operators.Function("a", shifted), TypeError, "Function: matvec must be callable, got 'a'"),
        (lambda: operators.Function(torch.eye(9)), TypeError, r"must be callable, got a tensor of shape \(9, 9\)"),
        (lambda: operators.Function(shifted, 3), TypeError, "Function: transpose must be callable, got 3"),
        (lambda: operators.Function(shifted, diagonal=3), TypeError, "Function: diagonal must be callable, got 3"),
        (lambda: operators.Function(shifted, shifted, symmetric=True), ValueError, "give only one of the two"),
        (lambda: operators.Function(shifted, tensors=3.0), TypeError, "tensors must be a tuple of tensors, got 3.0"),
        (lambda: operators.Function(shifted, shifted_transpose, (3.0,)), TypeError, "every tensor must be a torch"),
        (
            lambda: solve_with(lambda v: v[:, 1:]),
            ValueError,
            r"matvec must return what it was given, \[2, 4\] in float32",
        ),
        (lambda: solve_with(lambda v: v.double()), ValueError, "matvec must return what it was given"),
        (lambda: solve_with(lambda v: None), TypeError, "matvec must return a torch tensor, got NoneType"),
        (lambda: solve_with(lambda v: v.to("meta")), ValueError, "matvec must return a tensor on cpu, got one on meta"),
        (lambda: solve_with(lambda v: v.mul_(2.0)), ValueError, "matvec changes its arguments in place"),
        (lambda: solve_with(in_place, tensors=torch.ones(4)), ValueError, "matvec changes its arguments in place"),
        (
            lambda: solve_with(lambda v: v, prdp.Jacobi(3), diagonal=lambda: None),
            TypeError,
            "diagonal must return a torch tensor, got NoneType",
        ),
        (
            lambda: solve_with(lambda v: v, prdp.Jacobi(3), diagonal=lambda: torch.ones(3)),
            ValueError,
            r"diagonal must return a shape that broadcasts against the vectors, \[2, 4\], got \[3\]",
        ),
        (lambda: solve_with(lambda v: v, prdp.Jacobi(3)), ValueError, "its diagonal, which Jacobi and preconditioner"),
        (lambda: solve_with(lambda v: v / (1 / 0)), ZeroDivisionError, "division by zero"),
    ],
)
def test_mistakes(call, error, message):
    with pytest.raises(error, match=message):
        call()


def solve_with(matvec, solver=None, **options):
    transpose = {} if "diagonal" in options or "tensors" in options else {"transpose": matvec}
    a = operators.Function(matvec, **transpose, **options)
    return prdp.linear_solve(a, torch.ones(2, 4), solver or prdp.GMRES(3))


def in_place(v, k):
    return v * k.add_(1.0)


def diagonal(k, s):
    return 2 + k**2


WITHOUT_TRANSPOSE = [prdp.GMRES(3, restart=6, rtol=0.0), prdp.Jacobi(90, rtol=1e-15), prdp.Direct()]


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", WITHOUT_TRANSPOSE, ids=["gmres", "jacobi", "direct"])
def test_without_a_transpose_it_is_torchs_own_derivative(solver, backward):
    """And with a diagonal Jacobi works, whose own derivative counts in unrolled mode."""
    k, s = (t.requires_grad_() for t in tensors())
    b = right_hand_side().requires_grad_()

    def solve(b, k, s):
        a = operators.Function(shifted, tensors=(k, s), diagonal=diagonal)
        return prdp.linear_solve(a, b, solver, backward=backward)[0]

    a = operators.Function(shifted, tensors=(k, s))
    torch.testing.assert_close(a.apply_transpose(b), shifted_transpose(b, k, s))
    torch.testing.assert_close(solve(b, k, s), torch.linalg.solve(dense(k, s), b))
    assert torch.autograd.gradcheck(solve, (b, k, s))
    assert torch.autograd.gradgradcheck(solve, (b, k, s), fast_mode=True)


def test_few_jacobi_sweeps_unrolled_differentiate_the_diagonal():
    k, s = (t.requires_grad_() for t in tensors())
    b = right_hand_side().requires_grad_()

    def by_hand(b, k, s):
        u = torch.zeros_like(b)
        for _ in range(3):
            u = u + (b - shifted(u, k, s)) / diagonal(k, s)
        return u

    a = operators.Function(shifted, tensors=(k, s), diagonal=diagonal)
    u, _ = prdp.linear_solve(a, b, prdp.Jacobi(3), backward="unrolled")
    expected = by_hand(b, k, s)
    torch.testing.assert_close(u, expected)
    found, truth = (torch.autograd.grad((x**2).sum(), (b, k, s)) for x in (u, expected))
    torch.testing.assert_close(found, truth)


def test_symmetric_says_that_matvec_is_its_own_transpose():
    calls = []

    def scaled(v, k):
        calls.append(torch.is_grad_enabled())
        return k * v

    k, v = torch.tensor(2.0), torch.ones(2, 4)
    a = operators.Function(scaled, tensors=k, symmetric=True)  # a single tensor will do
    with torch.no_grad():
        assert torch.equal(a.apply_transpose(v), 2 * v)
    assert calls == [False]


def test_a_product_that_torch_cannot_differentiate_needs_a_transpose():
    def detached(v):
        return torch.from_numpy(2 * v.detach().numpy())

    b = right_hand_side().requires_grad_()
    u, _ = prdp.linear_solve(operators.Function(detached), b, prdp.GMRES(3))
    with pytest.raises(ValueError, match=r"torch cannot differentiate matvec .* or give transpose"):
        u.sum().backward()
    u, _ = prdp.linear_solve(operators.Function(detached, symmetric=True), b, prdp.GMRES(3))
    u.sum().backward()
    torch.testing.assert_close(b.grad, torch.full_like(b, 0.5))


def test_copies_and_pickles():
    a = operators.Function(shifted, shifted_transpose, tensors(), diagonal)
    v = right_hand_side()
    for clone in (copy.deepcopy(a), pickle.loads(pickle.dumps(a))):
        clone.tensors[1].fill_(0.0)
        torch.testing.assert_close(clone.apply(v), diagonal(*clone.tensors) * v)
        torch.testing.assert_close(clone.diagonal(), a.diagonal())
    assert a.tensors[1] == 0.7


@pytest.mark.parametrize("size, dtype", [(1e25, torch.float32), (1e-25, torch.float32), (2.0**600, torch.float64)])
def test_unrolled_iterations_refuse_an_operator_whose_size_squared_underflows(size, dtype):
    """Their derivative would be off by more than itself in silence."""
    b = torch.randn(1, 1, 16, dtype=dtype, requires_grad=True)
    q = torch.tensor(size, dtype=dtype)
    a = operators.Function(lambda v, q: (3 * v - v.roll(1, -1) - v.roll(-1, -1)) * q, tensors=(q,), symmetric=True)
    with pytest.raises(ValueError, match=r"unrolled in \w+, A may change the size of a vector by a factor of 2\^"):
        prdp.linear_solve(a, b, prdp.SteepestDescent(8), backward="unrolled")[0].sum().backward()
