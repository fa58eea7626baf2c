"""The sides of operators.Diffusion: values and fluxes given there, and whether they hold u, also in float32."""

import subprocess
import sys
import warnings

import pytest
import torch
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


HELD = [
    (blob(64, 1e3), {"shift": 1.0, "boundary": "flux"}, None),  # products of differences keep it
    (blob(64, 1e3), {"shift": 1.0, "boundary": ("robin", 0.0)}, "act as one of about 1, is lost in the rounding"),
    (blob(64, 1e3).double(), {"shift": 1.0, "boundary": ("robin", 0.0)}, None),
    (blob(128, 1.3), {"shift": at_sides(128, 2e-3), "boundary": "flux"}, None),
    (blob(128, 1.3), {"boundary": ("robin", 2e-3)}, "sides that act as one of about 0.00799"),
    (blob(128, 1.3), {"boundary": ("robin", 1.0)}, None),
    (blob(64, 1e5), {"boundary": "zero"}, "is lost in the rounding"),
    (blob(64, 1e2), {"boundary": "zero", "shift": 1e-4}, None),
    (blob(64, 1e5), {"boundary": "flux"}, None),  # nothing holds u, and A knows
]


@pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol")  # u may be wrong then, but is not here
@pytest.mark.parametrize("kappa, given, words", HELD)
def test_it_warns_of_a_hold_that_float32_loses(kappa, given, words):
    """And where it does not, u is right: against float64."""
    torch.set_warn_always(True)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            a = Diffusion(kappa, **given)
    finally:
        torch.set_warn_always(False)
    assert [words in str(w.message) for w in told] == ([True] if words else [])
    if words or a.kind == "singular_diffusion":
        return
    exact = Diffusion(kappa.double(), **{k: v.double() if torch.is_tensor(v) else v for k, v in given.items()})
    b = torch.ones(1, 1, *kappa.shape[1:])
    solver = prdp.CG(300, rtol=1e-6, preconditioner="multigrid")
    u = prdp.linear_solve(a, b.to(kappa.dtype), solver)[0]
    expected = prdp.linear_solve(exact, b.double(), prdp.Direct())[0]
    assert (u - expected).norm() < 2e-3 * expected.norm()


def test_what_float32_cannot_hold_is_not_called_singular():
    """A is definite; there is no nullspace= that could be given."""
    a = Diffusion(blob(128, 1.3), at_sides(128, 2e-3), boundary="flux")
    with pytest.raises(torch.linalg.LinAlgError, match="A is singular to float32; take float64"):
        prdp.linear_solve(a, torch.ones(1, 1, 128, 128), prdp.Direct())


WARNS_ONCE = """
import torch, prdp_torch as prdp
kappa = torch.ones(1, 64, 64)
kappa[:, 20:40, 20:40] = 1e3
for _ in range(2):
    a = prdp.operators.Diffusion(kappa, shift=1.0, boundary=("robin", 0.0))
    prdp.linear_solve(a, torch.ones(1, 1, 64, 64), prdp.CG(2, rtol=0.0), on_failure="return")
"""


def test_it_warns_once():
    done = subprocess.run([sys.executable, "-c", WARNS_ONCE], capture_output=True, text=True, check=True)
    assert done.stderr.count("act as one of about 1, is lost in the rounding") == 1


@pytest.mark.parametrize("values, words", [
    ((1.0, 2.0), r"values must be one for all sides or a pair \(low, high\) for each of 2 axes, got \(1.0, 2.0\)"),
    (torch.ones(1, 7), r"values must broadcast to \(batch or 1, \*side\), here \(1, 5\), got \(1, 7\)"),
    (torch.ones(7), r"values must broadcast to \(batch or 1, \*side\), here \(1, 5\), got \(7,\)"),
])  # fmt: skip
def test_values_that_do_not_fit_the_sides_are_named(values, words):
    with pytest.raises(ValueError, match=words):
        Diffusion(torch.ones(1, 4, 5)).boundary_rhs(values=values)
