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


CASES = {
    "stencils": stencil(3),
    "a stencil of all": stencil(1),
    "diffusion": diffusion(3, boundary=("flux", "periodic")),
    "diffusion of all": diffusion(1, boundary=("zero", ("flux", "zero")), faces="arithmetic", length=(1.0, 2.0)),
    "shift": with_shift(*diffusion(3, boundary=("zero", "periodic"))),
}


def gradients(name, dtype=F64, **device):
    make, fields, channels = CASES[name]
    leaves = [t.to(dtype).requires_grad_() for t in fields]
    b = noise(3, channels, *SHAPE, seed=3, dtype=dtype)
    method = prdp.BiCGStab if "stencil" in name else prdp.CG

    def run():
        u, _ = prdp.linear_solve(make(*leaves), b, method(100, rtol=1e-12 if dtype == F64 else 1e-6))
        before = Fibers().launches()
        found = torch.autograd.grad(u.square().sum(), leaves)
        return found, Fibers().launches() - before

    if not device:
        return run()
    with Fibers(**device):
        return run()


@pytest.mark.parametrize("name", CASES)
def test_they_are_those_of_the_cpu_in_one_launch(name):
    (expected, _), (found, launches) = gradients(name), gradients(name, threads=32)
    assert launches == 2  # the adjoint solve, and the products
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("name", ["a stencil of all", "diffusion of all"])
def test_sums_over_the_batch_have_one_order(name):
    wanted, _ = gradients(name, F32, threads=32)
    for order in (BACKWARD, SHUFFLED):
        found, _ = gradients(name, F32, threads=32, order=order)
        assert all(torch.equal(mine, other) for mine, other in zip(found, wanted, strict=True))
