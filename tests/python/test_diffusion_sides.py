"""The sides of operators.Diffusion: values and fluxes given there, and whether they hold u, also in float32."""

import pytest
import torch
from helpers import field
from test_diffusion import F64, rand

import prdp_torch as prdp
from prdp_torch.operators import Diffusion


def test_without_a_hold_the_mean_is_free():
    kappa = rand(1, 8, 8).requires_grad_()
    for boundary in ("flux", "periodic", ["flux", "periodic"]):
        a = Diffusion(kappa, boundary=boundary)
        b = rand(2, 1, 8, 8, seed=4)
        _, info = prdp.linear_solve(a, b, prdp.CG(200, rtol=1e-10), on_failure="return")
        assert (info.status == prdp.SolveStatus.INCONSISTENT).all()
        b = b - b.mean((-2, -1), keepdim=True)
        for solver in (prdp.CG(200, rtol=1e-11), prdp.Direct(), prdp.CG(30, rtol=1e-11, preconditioner="multigrid")):
            u, info = prdp.linear_solve(a, b, solver)
            assert info.solved.all() and u.mean((-2, -1)).abs().max() < 1e-14
            (g,) = torch.autograd.grad(u.sum() + u.square().sum(), kappa)
            assert g.isfinite().all() and g.abs().max() < 1e3


def test_values_and_fluxes_at_the_sides():
    """A straight line, and a layered medium whose flux the harmonic mean makes exact."""
    n = 10
    kappa = torch.ones(1, n, 3, dtype=F64)
    kappa[:, n // 2 :] = 100.0
    a = Diffusion(kappa, boundary=["zero", "flux"])
    b = a.boundary_rhs(values=[(1.0, 3.0), (0.0, 0.0)])
    u, _ = prdp.linear_solve(a, b, prdp.Direct())
    flux = 2.0 / (0.5 / 1 + 0.5 / 100)
    x = (torch.arange(n, dtype=F64) + 0.5) / n
    expected = torch.where(x < 0.5, 1 + flux * x, 3 - flux / 100 * (1 - x))
    torch.testing.assert_close(u[0, 0], expected[:, None].expand(n, 3), rtol=1e-10, atol=1e-10)

    assert torch.equal(b, a.boundary_rhs(values=[(1.0, 3.0), (None, None)], fluxes=[(None, None), (0.0, None)]))

    a = Diffusion(torch.full((1, n), 2.0, dtype=F64), boundary=[("zero", "flux")], length=4.0)
    inflow = torch.tensor(0.5, dtype=F64, requires_grad=True)
    u, _ = prdp.linear_solve(a, a.boundary_rhs(values=1.0, fluxes=inflow), prdp.Direct())
    torch.testing.assert_close(u[0, 0], 1 + 0.25 * 4 * x, rtol=1e-10, atol=1e-10)
    (slope,) = torch.autograd.grad(u[0, 0, -1], inflow)
    torch.testing.assert_close(slope, 0.5 * 4 * x[-1], rtol=1e-10, atol=1e-10)


def test_values_of_sides_may_differ_in_their_batch():
    """One side has a value for each sample, the next one for all; each as if it were alone."""
    a = Diffusion(rand(1, 4, 3), boundary=["zero", "flux"])
    left, flux = rand(5, 3, seed=1), rand(5, 4, seed=2)
    many = a.boundary_rhs(values=[(left, 2.0), (0.0, 0.0)], fluxes=[(0.0, 0.0), (flux, 0.5)])
    assert many.shape == (5, 1, 4, 3)
    for i in range(5):
        one = a.boundary_rhs(values=[(left[i : i + 1], 2.0), (0.0, 0.0)], fluxes=[(0.0, 0.0), (flux[i : i + 1], 0.5)])
        torch.testing.assert_close(many[i : i + 1], one)
    with pytest.raises(ValueError, match="Diffusion: the high side of axis 0 holds 2 samples, the sides before it 5"):
        a.boundary_rhs(values=[(left, left[:2]), (0.0, 0.0)])


def test_values_and_fluxes_that_no_side_takes_are_refused():
    a = Diffusion(torch.ones(1, 4, 3), boundary="flux")
    with pytest.raises(ValueError, match="Diffusion: values belong to sides that are 'zero' or 'robin'; the boundary"):
        a.boundary_rhs(values=1.0)
    with pytest.raises(ValueError, match="Diffusion: values belong to sides that are 'zero'"):
        Diffusion(torch.ones(1, 4), boundary=[("flux", "zero")]).boundary_rhs(values=[(1.0, 0.0)])
    with pytest.raises(ValueError, match="Diffusion: fluxes belong to sides that are 'flux'"):
        Diffusion(torch.ones(1, 4), boundary="zero").boundary_rhs(fluxes=torch.ones(()))
    assert not a.boundary_rhs(values=0.0).any()


def blob(n, jump):
    kappa = torch.ones(1, n, n)
    kappa[:, n // 3 : n // 2, n // 3 : n // 2] = jump
    return kappa


def at_sides(n, h):
    """Robin sides by hand: a shift that is zero inside."""
    shift = torch.zeros(1, n, n)
    for side in (shift[:, 0], shift[:, -1], shift[..., 0], shift[..., -1]):
        side += h * n
    return shift


HELD = {
    "a shift": (blob(64, 1e3), {"shift": 1.0, "boundary": "flux"}),
    "a shift beside sides that hold nothing": (blob(64, 1e3), {"shift": 1.0, "boundary": ("robin", 0.0)}),
    "a shift at the sides": (blob(128, 1.3), {"shift": at_sides(128, 2e-3), "boundary": "flux"}),
    "weak sides": (blob(128, 1.3), {"boundary": ("robin", 2e-3)}),
    "a jump of 1e5": (blob(64, 1e5), {"boundary": "zero"}),
    "cells of a micrometre": (blob(64, 2e2), {"boundary": ("robin", 5.0), "shift": 1e6, "length": 64e-6}),
    "one side": (blob(64, 30.0), {"boundary": [(("robin", 0.5), "flux"), "periodic"], "length": [3.0, 1.0]}),
    "three axes": (blob(9, 1e4)[:, None].repeat(1, 2, 1, 1), {"boundary": ["flux", ("zero", "flux"), "zero"]}),
    "one axis": (torch.tensor([[1.0, 1e4] * 40]), {"boundary": [("zero", "flux")]}),
    "a kappa for each sample": (torch.cat([blob(32, 1e4), blob(32, 1.0)]), {"boundary": "zero"}),
}
BY_EVERY_METHOD = {
    "CG": (prdp.CG(5000, rtol=1e-6), 1e-4),
    "CG, multigrid": (prdp.CG(60, rtol=1e-6, preconditioner="multigrid"), 1e-6),
    "MINRES, multigrid": (prdp.MINRES(60, rtol=1e-6, preconditioner="multigrid"), 1e-6),
    "Multigrid": (prdp.Multigrid(60, rtol=1e-6), 1e-6),
    "Direct": (prdp.Direct(), 1e-6),
}


# The residual is the rounding of u, times κ/h².
@pytest.mark.filterwarnings(
    "ignore:.* STAGNATED far above rtol", "ignore:.* with a residual above", "ignore:.* did not reach rtol"
)
@pytest.mark.parametrize("method", BY_EVERY_METHOD)
@pytest.mark.parametrize("held_by", HELD)
def test_float32_keeps_what_holds_u(held_by, method):
    """However little that is beside the diagonal: against float64."""
    kappa, given = HELD[held_by]
    solver, bound = BY_EVERY_METHOD[method]
    wide = {k: v.double() if torch.is_tensor(v) else v for k, v in given.items()}
    b = torch.ones(2, 1, *kappa.shape[1:])
    b[1] = torch.rand(kappa.shape[1:], generator=torch.Generator().manual_seed(0)) - 0.3
    u, _ = prdp.linear_solve(Diffusion(kappa, **given), b, solver)
    expected = prdp.linear_solve(Diffusion(kappa.double(), **wide), b.double(), prdp.Direct())[0]
    assert ((u - expected).flatten(1).norm(dim=1) < bound * expected.flatten(1).norm(dim=1)).all()


def test_a_truncated_solve_hands_out_its_iterate_though_rounding_hides_its_energy():
    """Of a jump of 1e4 in float32, CG's residual is above ‖b‖ for thousands of iterations while u comes nearer."""
    kappa, b = blob(96, 1e4), torch.ones(1, 1, 96, 96)
    exact = prdp.linear_solve(Diffusion(kappa.double()), b.double(), prdp.Direct())[0]
    errors = []
    for count in (300, 1000, 2000):
        u, info = prdp.linear_solve(Diffusion(kappa), b, prdp.CG(count, rtol=0.0))
        assert (info.status == prdp.SolveStatus.MAX_ITER).all() and (info.iterations == count).all()
        errors.append(((u - exact).norm() / exact.norm()).item())
    assert errors[0] < 0.1 and errors[1] < 0.03 and errors[2] < 5e-3


@pytest.mark.parametrize("shape", [(31,), (20, 33), (5, 8, 6)], ids=str)
@pytest.mark.parametrize("boundary", ["zero", "low side", ("robin", 0.5)], ids=str)
def test_a_rise_above_the_values_at_the_sides(shape, boundary):
    """Sides at 300 and a source that raises u by about one: float32 rounds b, but nothing else of the 300."""
    b = torch.full((1, 1, *shape), 10.0)
    boundary = [("zero", "flux")] * len(shape) if boundary == "low side" else boundary
    found = []
    for dtype in (torch.float32, F64):
        a = Diffusion(torch.ones(1, *shape, dtype=dtype), boundary=boundary)
        rhs = a.boundary_rhs(values=300.0).to(F64) + b.to(F64)
        found.append(prdp.linear_solve(a, rhs.to(dtype), prdp.Direct())[0].double() - 300.0)
    assert (found[0] - found[1]).norm() < 1e-3 * found[1].norm()


@pytest.mark.parametrize("values, words", [
    ((1.0, 2.0), r"values must be a number, a tensor, or a pair \(low, high\) for each of 2 axes, "
     r"\(None, None\) for one without, got \(1.0, 2.0\)"),
    (torch.ones(1, 7), r"values must broadcast to \(batch or 1, \*side\), here \(1, 5\), got \(1, 7\)"),
    (torch.ones(7), r"values must broadcast to \(batch or 1, \*side\), here \(1, 5\), got \(7,\)"),
])  # fmt: skip
def test_values_that_do_not_fit_the_sides_are_named(values, words):
    with pytest.raises(ValueError, match=words):
        Diffusion(torch.ones(1, 4, 5)).boundary_rhs(values=values)


@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node")  # by torch.func.linearize
def test_boundary_rhs_is_linearised():
    """torch.func.linearize loses what a function sets in a tensor of its own."""
    boundary = ["zero", (("robin", 0.3), "flux")]

    def made(kappa, value, flux):
        a = Diffusion(kappa, 1.0, boundary)
        return a.boundary_rhs(values=[(value, 2.0), (value, 0.0)], fluxes=[(0.0, 0.0), (0.0, flux)])

    given = (0.5 + field((4, 5))[:, 0].abs(), torch.tensor(1.5, dtype=F64), torch.tensor(-0.7, dtype=F64))
    tangents = (field((4, 5), seed=1)[:, 0], torch.tensor(0.3, dtype=F64), torch.tensor(2.0, dtype=F64))
    b, linear = torch.func.linearize(made, *given)
    torch.testing.assert_close(b, made(*given))
    torch.testing.assert_close(linear(*tangents), torch.func.jvp(made, given, tangents)[1])


def test_a_box_without_cells_is_refused():
    for shape in ((8, 0), (0, 8), (0,)):
        with pytest.raises(ValueError, match=r"Diffusion: every extent of shape must be >= 1, got \("):
            Diffusion(torch.ones(1, *shape))


def test_what_a_constant_null_space_forbids_is_called_the_mean():
    insulated, b = Diffusion(torch.ones(1, 6, 5, dtype=F64), 0.0, "flux"), 1.0 + field((6, 5))
    with pytest.raises(torch.linalg.LinAlgError, match="b lies outside the range of A; take the mean off b"):
        prdp.linear_solve(insulated, b, prdp.CG(50))
