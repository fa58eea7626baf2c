"""operators.Diffusion with a κ of its own along each axis, against assembled matrices and closed forms."""

import numpy as np
import pytest
import torch
from fibers import Fibers
from test_diffusion import CASES, F64, matrix, rand

import prdp_torch as prdp
from prdp_torch.operators import Diffusion


def matrix_per_axis(kappa, shift, sides, lengths, faces="harmonic"):
    """The sum over the axes of what diffuses along each: the box is endless in the others."""
    a = np.diag(np.asarray(shift).ravel())
    for axis in range(len(kappa)):
        along = [length if axis == d else np.inf for d, length in enumerate(lengths)]
        a = a + matrix(kappa[axis], 0.0, sides, along, faces)
    return a


def ground(*shape, samples=2, seed=0, decades=3):
    """Up to so many decades more conductive along the last axis."""
    kappa = rand(samples, len(shape), *shape, seed=seed)
    return kappa * torch.logspace(0, decades, len(shape), dtype=F64).view(-1, *[1] * len(shape))


@pytest.mark.parametrize("faces", ["harmonic", "arithmetic"])
@pytest.mark.parametrize("shape, sides, lengths", CASES, ids=str)
def test_products_solves_and_gradients(shape, sides, lengths, faces):
    kappa, shift = ground(*shape), rand(2, *shape, seed=1)
    a = Diffusion(kappa, shift, boundary=sides, length=lengths, faces=faces, per_axis=True)
    dense = np.stack([matrix_per_axis(kappa[i], shift[i], sides, lengths, faces) for i in range(2)])
    np.testing.assert_allclose(a.dense(), dense, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(a.diagonal().flatten(1), np.einsum("bii->bi", dense), rtol=1e-12)
    v = rand(2, 3, *shape, seed=2)
    np.testing.assert_allclose(
        a.apply(v).flatten(2), np.einsum("bij,bcj->bci", dense, v.flatten(2).numpy()), rtol=1e-11, atol=1e-9
    )
    assert prdp.check_operator(a, v)
    exact = np.linalg.solve(dense[:, None], v.flatten(2).numpy()[..., None])[..., 0]
    for solver in (prdp.Direct(), prdp.CG(400, rtol=1e-12), prdp.CG(90, rtol=1e-12, preconditioner="multigrid")):
        np.testing.assert_allclose(prdp.linear_solve(a, v, solver)[0].flatten(2), exact, rtol=1e-7, atol=1e-9)

    def loss(kappa, shift):
        a = Diffusion(kappa, shift, boundary=sides, length=lengths, faces=faces, per_axis=True)
        return prdp.linear_solve(a, v, prdp.Direct())[0].square().sum()

    inputs = ground(*shape, decades=1).requires_grad_(), shift.requires_grad_()
    assert torch.autograd.gradcheck(loss, inputs, rtol=1e-4, atol=1e-6)


def test_the_same_kappa_along_all_axes_is_one_kappa():
    kappa, b = rand(2, 6, 5), rand(2, 1, 6, 5, seed=1)
    leaves = kappa.clone().requires_grad_(), kappa[:, None].repeat(1, 2, 1, 1).requires_grad_()
    solver = prdp.CG(100, rtol=1e-12)
    one = prdp.linear_solve(Diffusion(leaves[0]), b, solver)[0]
    two = prdp.linear_solve(Diffusion(leaves[1], per_axis=True), b, solver)[0]
    torch.testing.assert_close(one, two, rtol=1e-10, atol=1e-12)
    bars = [torch.autograd.grad(u.square().sum(), leaf)[0] for u, leaf in zip((one, two), leaves, strict=True)]
    torch.testing.assert_close(bars[1].sum(1), bars[0], rtol=1e-9, atol=1e-12)


def test_a_plane_between_values_and_fluxes_is_exact():
    """Constant κ, so u = 1 + 2 y - 3 x solves the equation in the cells exactly, with what flows at the sides."""
    along_y, along_x = 2.0, 0.5
    kappa = torch.tensor([along_y, along_x], dtype=F64)[None, :, None, None].expand(1, 2, 4, 5)
    h = 0.7
    y, x = ((torch.arange(n, dtype=F64) + 0.5) / n for n in (4, 5))
    plane = 1 + 2 * y[:, None] - 3 * x
    a = Diffusion(kappa, boundary=[("zero", "flux"), (("robin", h), "zero")], per_axis=True)
    at_low = 1 + 2 * y  # u at x = 0, where -κ ∂u/∂n = -3 κ flows out into a bath of u_ext
    b = a.boundary_rhs(
        values=[(1 - 3 * x, 0.0), (at_low + 3 * along_x / h, at_low - 3)], fluxes=[(0.0, 2 * along_y), (0.0, 0.0)]
    )
    u, _ = prdp.linear_solve(a, b, prdp.Direct())
    torch.testing.assert_close(u[0, 0], plane, rtol=1e-12, atol=1e-12)


def test_robin_sides_get_their_gradient():
    kappa, b = ground(3, 4, samples=2), rand(2, 1, 3, 4, seed=1)

    def loss(kappa, h):
        a = Diffusion(kappa, 0.5, boundary=[(("robin", h), "flux"), "zero"], per_axis=True)
        return prdp.linear_solve(a, b, prdp.Direct())[0].square().sum()

    h = rand(2, 4, seed=2)
    assert torch.autograd.gradcheck(loss, (kappa.requires_grad_(), h.requires_grad_()), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("preconditioner", [None, "multigrid"])
def test_kernels_solve_it(preconditioner):
    kappa, b = ground(6, 5, samples=3), rand(3, 1, 6, 5, seed=1)
    solver = prdp.CG(300, rtol=1e-11, preconditioner=preconditioner)

    def run():
        leaf = kappa.clone().requires_grad_()
        u, info = prdp.linear_solve(Diffusion(leaf, boundary=["flux", "zero"], per_axis=True), b, solver)
        return u, torch.autograd.grad(u.square().sum(), leaf)[0], info

    expected = run()
    with Fibers():
        found = run()
    assert found[2].way == "kernel" and found[2].solved.all()
    torch.testing.assert_close(found[:2], expected[:2], rtol=1e-8, atol=1e-10)


def test_transforms_and_a_step():
    b, solver = rand(2, 1, 3, 4, seed=1), prdp.CG(200, rtol=1e-12)

    def solve(kappa):
        return prdp.linear_solve(Diffusion(kappa, boundary="flux", shift=1.0, per_axis=True), b, solver)[0]

    many = torch.stack([ground(3, 4), ground(3, 4, seed=5)])
    torch.testing.assert_close(torch.func.vmap(solve)(many), torch.stack([solve(k) for k in many]))
    gradient = torch.func.grad(lambda k: solve(k).square().sum())(many[0])
    leaf = many[0].clone().requires_grad_()
    torch.testing.assert_close(gradient, torch.autograd.grad(solve(leaf).square().sum(), leaf)[0])
    step = prdp.ImplicitStep(Diffusion(torch.nn.Parameter(many[0][:1]), 1.0, per_axis=True), solver=solver)
    assert {name: p.shape for name, p in step.named_parameters()} == {"operator_at.kappa": (1, 2, 3, 4)}
    step.rollout(b, 2)[:, -1].square().sum().backward()
    assert step.operator_at.kappa.grad.flatten(2).any(2).all()


def test_without_a_hold_the_mean_is_free():
    kappa, b = ground(4, 5), rand(2, 1, 4, 5, seed=1)
    b -= b.mean((2, 3), keepdim=True)
    a = Diffusion(kappa, boundary=["flux", "periodic"], per_axis=True)
    for solver in (prdp.CG(200, rtol=1e-11), prdp.Direct()):
        u, info = prdp.linear_solve(a, b, solver)
        assert info.solved.all() and u.mean((2, 3)).abs().max() < 1e-10
        torch.testing.assert_close(a.apply(u), b, rtol=1e-8, atol=1e-8)


def test_mistakes_are_named():
    for kappa, given, words in (
        (torch.ones(1, 4, 5), {}, r"kappa must have shape \(batch or 1, axes, \*shape\) .*, got \(1, 4, 5\)"),
        (torch.ones(1, 3, 4, 5), {}, r"kappa must have shape \(batch or 1, axes, \*shape\) .*, got \(1, 3, 4, 5\)"),
        (
            torch.ones(1, 2, 4, 5),
            {"shift": torch.ones(1, 2, 4, 5)},
            r"or a field \(batch or 1, 4, 5\), got \(1, 2, 4, 5\)",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            Diffusion(kappa, per_axis=True, **given)
    kappa = torch.ones(3, 2, 4, 5)
    kappa[1, 1, 2, 3] = -2
    with pytest.raises(ValueError, match=r"kappa must be > 0, got -2 in sample 1 at index \(1, 2, 3\)"):
        prdp.linear_solve(Diffusion(kappa, per_axis=True), torch.ones(3, 1, 4, 5), prdp.CG(3))
    _, info = prdp.linear_solve(
        Diffusion(kappa, per_axis=True), torch.ones(3, 1, 4, 5), prdp.CG(90), on_failure="return"
    )
    assert info.failed.tolist() == [False, True, False]
