"""Derivatives of products and solves with stencils, first and second, and under torch.compile."""

import numpy as np
import pytest
import torch
from helpers import field
from stencils import CASES, FAR_2D, FEW, NEAREST, dense, few, random_coefficients
from torch.autograd import gradcheck, gradgradcheck
from torch.library import opcheck

import prdp_torch as prdp
from prdp_torch import operators
from prdp_torch.solvers import packed_options


def solution(c, b, offsets, boundary, solver, backward):
    return prdp.linear_solve(operators.Stencil(c, offsets, boundary), b, solver, backward=backward)[0]


@few
@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_gradients_of_a_converged_solve_equal_the_dense_ones(shape, offsets, boundary, batch, backward):
    c, b = (
        random_coefficients(shape, offsets, batch).requires_grad_(),
        field(shape, seed=5, channels=2).requires_grad_(),
    )
    g = field(shape, seed=6, channels=2)
    m = np.broadcast_to(dense(c, offsets, boundary), (2, *[np.prod(shape)] * 2))
    u = np.linalg.solve(m[:, None], b.detach().flatten(2).numpy()[..., None])[..., 0]
    adjoint = np.linalg.solve(m[:, None].swapaxes(-1, -2), g.flatten(2).numpy()[..., None])[..., 0]
    bar = -np.einsum("bci,bcj->bij", adjoint, u)
    # What a coefficient does to the matrix, one by one.
    expected = np.zeros((2, *c.shape[1:]))
    for index in np.ndindex(*c.shape[1:]):
        unit = torch.zeros(1, *c.shape[1:], dtype=torch.float64)
        unit[(0, *index)] = 1
        row = np.ravel_multi_index(index[1:], shape)
        expected[(slice(None), *index)] = bar[:, row] @ dense(unit, offsets, boundary)[0, row]
    if batch == 1:
        expected = expected.sum(0, keepdims=True)
    for solver in (prdp.Jacobi(800, rtol=1e-14), prdp.GMRES(60, rtol=1e-14, restart=5), prdp.Direct()):
        grads = torch.autograd.grad(solution(c, b, offsets, boundary, solver, backward), (c, b), g)
        np.testing.assert_allclose(grads[0], expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(grads[1].flatten(2), adjoint, rtol=1e-9, atol=1e-9)


UNROLLED = [prdp.Jacobi(3, rtol=0.0), prdp.SteepestDescent(3, rtol=0.0), prdp.CG(3, rtol=0.0)]
UNROLLED += [prdp.GMRES(2, rtol=0.0, restart=3), prdp.Direct()]


@pytest.mark.parametrize("shape, offsets, boundary", [FEW[i] for i in (0, 2, 4, 6, 7)])
@pytest.mark.parametrize("solver", UNROLLED, ids=lambda s: s.method)
def test_unrolled_gradients_are_those_of_the_iterations(shape, offsets, boundary, solver):
    """Two channels and both ways of sharing; far from converged, so that the derivative is the map's own."""
    small = tuple(min(n, 4) for n in shape)
    b = field(small, seed=5, channels=2).requires_grad_()
    for batch in (1, 2):
        c = random_coefficients(small, offsets, batch).requires_grad_()
        assert gradcheck(lambda c, b: solution(c, b, offsets, boundary, solver, "unrolled"), (c, b), fast_mode=True)


@few
def test_products_differentiate_twice(shape, offsets, boundary):
    small = tuple(min(n, 3) for n in shape)
    v = field(small, channels=2).requires_grad_()
    for batch in (1, 2):
        c = random_coefficients(small, offsets, batch).requires_grad_()
        for product in ("apply", "apply_transpose"):

            def f(c, v, product=product):
                return getattr(operators.Stencil(c, offsets, boundary), product)(v)

            assert gradcheck(f, (c, v), fast_mode=True) and gradgradcheck(f, (c, v), fast_mode=True)
    assert gradcheck(lambda c: operators.Stencil(c, offsets, boundary).diagonal(), c, fast_mode=True)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", [prdp.GMRES(40, rtol=1e-14), prdp.Direct()], ids=["gmres", "direct"])
@pytest.mark.parametrize("shape, offsets, boundary", [FEW[0], FEW[5], FEW[4]])
def test_solves_differentiate_twice(shape, offsets, boundary, solver, backward):
    small = tuple(min(n, 3) for n in shape)
    c, b = random_coefficients(small, offsets).requires_grad_(), field(small, seed=5).requires_grad_()

    def f(c, b):
        return solution(c, b, offsets, boundary, solver, backward)

    assert gradcheck(f, (c, b)) and gradgradcheck(f, (c, b), fast_mode=True)


def test_the_gradient_in_no_grad_mode_is_the_recorded_one():
    """The implicit derivative has loops of its own where nothing records."""
    for shape, offsets, boundary in CASES:
        for batch in (1, 2):
            c = random_coefficients(shape, offsets, batch).requires_grad_()
            u = solution(c, field(shape, channels=2), offsets, boundary, prdp.Direct(), "implicit")
            g = field(shape, seed=1, channels=2)
            plain, recorded = (
                torch.autograd.grad(u, c, g, retain_graph=True, create_graph=r)[0] for r in (False, True)
            )
            torch.testing.assert_close(plain, recorded.detach(), rtol=1e-11, atol=1e-12)


# opcheck looks at the .grad of results in between, which the ops made of others have.
of_several_ops = pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")


@of_several_ops
@pytest.mark.parametrize("shape, offsets, boundary", [FEW[i] for i in (0, 4, 8)])
def test_opcheck(shape, offsets, boundary):
    c, b = random_coefficients(shape, offsets).requires_grad_(), field(shape, seed=5, channels=2).requires_grad_()
    a = operators.Stencil(c, offsets, boundary)
    for backward in ("implicit", "unrolled"):
        for solver in ("jacobi", "direct"):
            options = packed_options(solver, 3, 1e-5, 3, None, backward)
            call = (b, a.tensors, a.kind, a.shape, a.parameters, False, None, *options)
            assert set(opcheck(torch.ops.prdp.linear_solve.default, call).values()) == {"SUCCESS"}
    call = (b, a.tensors, a.kind, a.shape, a.parameters, True)
    assert set(opcheck(torch.ops.prdp.apply.default, call).values()) == {"SUCCESS"}


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_compiled_solve_follows_k_and_compiles_at_most_twice(backward):
    torch._dynamo.reset()
    counter = torch._dynamo.testing.CompileCounterWithBackend("aot_eager")

    def solve(kappa, b, k):
        a = operators.Stencil(torch.stack([1 + 2 * kappa, -kappa, -kappa], 1), NEAREST[1], "periodic")
        return prdp.linear_solve(a, b, prdp.GMRES(k, restart=3), backward=backward)[0]

    compiled = torch.compile(solve, fullgraph=True, backend=counter)
    for k in range(1, 12):
        results = []
        for f in (solve, compiled):
            kappa, b = field((12,))[:, 0].exp().requires_grad_(), field((12,), seed=1).requires_grad_()
            u = f(kappa, b, k)
            results.append((u, *torch.autograd.grad((u**2).sum(), (kappa, b))))
        torch.testing.assert_close(results[1], results[0])
    assert counter.frame_count <= 2


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_a_compiled_solve_takes_any_batch(backward):
    torch._dynamo.reset()

    def solve(c, b):
        a = operators.Stencil(c, FAR_2D, ("zero", "periodic"))
        return prdp.linear_solve(a, b, prdp.Jacobi(4), backward=backward)[0]

    compiled = torch.compile(solve, fullgraph=True, backend="aot_eager")
    for batch in (2, 3, 5):
        results = []
        for f in (solve, compiled):
            c = random_coefficients((4, 5), FAR_2D, batch).requires_grad_()
            b = field((4, 5), batch, channels=2).requires_grad_()
            u = f(c, b)
            results.append((u, *torch.autograd.grad((u**2).sum(), (c, b))))
        torch.testing.assert_close(results[1], results[0])
