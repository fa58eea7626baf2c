"""Gradients of fields in one launch on a GPU, over the fibers, beside those of the CPU."""

import pytest
import torch
from fibers import BACKWARD, SHUFFLED, Fibers
from test_gpu_kernels import OFFSETS, SHAPE, coefficients, noise

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64


def stencil(rows):
    scale = 1.0 / coefficients(F64, rows).flatten(1).abs().amax(1)
    field = coefficients(F64, rows) * scale[:, None, None, None]
    return lambda c: operators.Stencil(c, OFFSETS, ("zero", "periodic")), [field], 2


def diffusion(rows, **settings):
    fields = [noise(rows, *SHAPE, seed=2).exp()]
    return lambda kappa, *shift: operators.Diffusion(kappa, *(shift or (50.0,)), **settings), fields, 1


def with_shift(make, fields, channels):
    return lambda kappa, shift: make(kappa, shift), [*fields, 20 + noise(1, *SHAPE)], channels


NU = torch.tensor(0.05, dtype=F64)
CASES = {
    "stencils": stencil(3),
    "a stencil of all": stencil(1),
    "diffusion": diffusion(3, boundary=("flux", "periodic")),
    "diffusion of all": diffusion(1, boundary=("zero", ("flux", "zero")), faces="arithmetic", length=(1.0, 2.0)),
    "burgers": (lambda w, nu: operators.Burgers(w, nu, 0.02), [noise(1, 2, *SHAPE), NU], 2),
    "burgers 1D": (lambda w, nu: operators.Burgers(w, nu, 0.02), [noise(3, 1, 11), NU], 1),
    "navier-stokes": (lambda w, nu: operators.NavierStokes(w, nu, 0.02), [noise(3, 2, *SHAPE), NU], 3),
    "navier-stokes of all": (lambda w, nu: operators.NavierStokes(w, nu, 0.02), [noise(1, 3, *SHAPE), NU], 3),
    "shift": with_shift(*diffusion(3, boundary=("zero", "periodic"))),
}


def solver_of(name, dtype):
    rtol = 1e-12 if dtype == F64 else 1e-6
    if name.startswith("navier"):
        return prdp.GMRES(40, rtol, restart=40)
    return prdp.CG(100, rtol) if "diffusion" in name or name == "shift" else prdp.BiCGStab(100, rtol)


def gradients(name, dtype=F64, **device):
    """And the launches of the backward pass."""
    make, fields, channels = CASES[name]
    leaves = [t.to(dtype, copy=True).requires_grad_() for t in fields]
    shape = fields[0].shape[2:] if "burgers" in name else SHAPE
    b = noise(3, channels, *shape, seed=3, dtype=dtype)
    if channels == 3:
        b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)

    def run():
        u, _ = prdp.linear_solve(make(*leaves), b, solver_of(name, dtype))
        before = Fibers().launches()
        found = torch.autograd.grad(u[:, :2].square().sum(), leaves)
        return found, Fibers().launches() - before

    if not device:
        return run()
    with Fibers(**device):
        return run()


@pytest.mark.parametrize("name", CASES)
def test_they_are_those_of_the_cpu_in_one_launch(name):
    (expected, _), (found, launches) = gradients(name), gradients(name, threads=32)
    assert launches == (3 if "burgers" in name or "navier" in name else 2)  # the adjoint solve; winds and ν
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("name", ["a stencil of all", "diffusion of all", "burgers"])
def test_sums_over_the_batch_have_one_order(name):
    wanted, _ = gradients(name, F32, threads=32)
    for order in (BACKWARD, SHUFFLED):
        found, _ = gradients(name, F32, threads=32, order=order)
        assert all(torch.equal(mine, other) for mine, other in zip(found, wanted, strict=True))
