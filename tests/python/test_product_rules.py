"""Gradients of fields by loops on the CPU, beside the tensor operations that a second derivative takes."""

import pytest
import torch
from test_gpu_products import CASES, NU, noise, per_axis, solver_of

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64


def burgers(rows, *shape):
    return lambda w, nu: operators.Burgers(w, nu, 0.002), [noise(rows, len(shape), *shape), NU], len(shape)


def navier_stokes(rows, *shape, channels=2):
    return lambda w, nu: operators.NavierStokes(w, nu, 0.02), [noise(rows, channels, *shape), NU], 3


BY_LOOPS = {name: case for name, case in CASES.items() if name.startswith(("diff", "burgers", "navier", "shift"))} | {
    "burgers of two points": burgers(3, 2),
    "burgers of 2 by 2": burgers(1, 2, 2),
    "burgers 17 by 33": burgers(3, 17, 33),
    "burgers 1D, long": burgers(3, 300),
    "navier-stokes of 2 by 3": navier_stokes(3, 2, 3),
    "navier-stokes 9 by 17": navier_stokes(3, 9, 17, channels=3),
    "diffusion of one cell": (operators.Diffusion, [noise(3, 1).exp(), torch.tensor(2.0, dtype=F64)], 2),
    "diffusion per axis 3D, wide": per_axis(1, 4, 9, 35, boundary=("zero", "flux", "periodic")),
}


def both(name, dtype):
    """The gradients by loops, and by tensor operations."""
    make, fields, channels = BY_LOOPS[name]
    leaves = [t.to(dtype, copy=True).requires_grad_() for t in fields]
    b = noise(3, channels, *make(*leaves).shape, seed=3, dtype=dtype)
    if channels == 3:
        b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)
    u, _ = prdp.linear_solve(make(*leaves), b, solver_of(name, dtype), on_failure="return")
    cotangent = 2.0 * u.detach()
    cotangent[:, 2:] *= 0.0 if channels == 3 else 1.0
    by_loops = torch.autograd.grad(u, leaves, cotangent, retain_graph=True)
    return by_loops, torch.autograd.grad(u, leaves, cotangent, create_graph=True)


@pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", BY_LOOPS)
def test_they_have_the_same_bits(name, dtype):
    """But where samples share a field: there the loops add them up first."""
    shared = BY_LOOPS[name][1][0].size(0) == 1
    rtol, atol = ((1e-12, 1e-12) if dtype == F64 else (1e-5, 1e-5)) if shared else (0.0, 0.0)
    for mine, other in zip(*both(name, dtype), strict=True):
        assert mine.abs().max() > 0
        torch.testing.assert_close(mine, other.detach(), rtol=rtol, atol=atol * float(other.detach().abs().max()))


def test_many_samples_share_a_field():
    """More than are added up at once."""
    kappa = noise(1, 5, 6).exp().requires_grad_()
    b, a = noise(37, 1, 5, 6), operators.Diffusion(kappa, boundary=("zero", ("robin", 2.0)))
    u, _ = prdp.linear_solve(a, b, prdp.Direct())
    (together,) = torch.autograd.grad(u, kappa, b, retain_graph=True)
    alone = [torch.autograd.grad(u[i], kappa, b[i], retain_graph=True)[0] for i in range(37)]
    torch.testing.assert_close(together, sum(alone), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    "name", ["burgers", "navier-stokes 9 by 17", "diffusion of all", "diffusion per axis 3D, wide"]
)
def test_threads_change_no_bit(name):
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(both(name, F32)[0])
    finally:
        torch.set_num_threads(before)
    for one, three in zip(*found, strict=True):
        assert torch.equal(one, three)


def test_a_wind_at_rest_has_half_of_each_side():
    """max(w, 0) and min(w, 0) at w = 0."""
    w = torch.zeros(1, 1, 8, dtype=F64, requires_grad=True)
    v, cotangent = noise(1, 1, 8, seed=1), noise(1, 1, 8, seed=2)
    a = operators.Burgers(w, torch.tensor(0.0, dtype=F64), 0.5)  # at rest A is the identity
    u, _ = prdp.linear_solve(a, v, prdp.Direct())
    (found,) = torch.autograd.grad(u, w, cotangent)
    # ∂/∂(wind of a face): half of ⟨λ, B u⟩ above it and of ⟨λ, F u⟩ below it; half of which goes to either point.
    difference = 0.5 * 8 * (v.roll(-1, 2) - v)
    face = -0.5 * difference * (cotangent + cotangent.roll(-1, 2))
    torch.testing.assert_close(found, 0.5 * (face + face.roll(1, 2)), rtol=1e-12, atol=1e-12)
