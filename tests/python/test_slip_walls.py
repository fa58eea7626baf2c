"""`Flow` between walls without friction: half of a flow that is mirrored at them."""

import math

import pytest
import torch
from flows import positions
from test_gpu_flow import F64, noise

import prdp_torch as prdp


def mirrored(u, boundary, length):
    """The velocity in a box that is twice as long along each axis with slip, and that box."""
    d = u.shape[1]
    for axis, end in enumerate(boundary):
        if end != "slip":
            continue
        parts = []
        for c in range(d):
            v = u[:, c : c + 1]
            a = axis + 2
            if c == d - 1 - axis:  # through the walls, on whose faces it is zero
                inner = v.narrow(a, 1, v.shape[a] - 1)
                wall = torch.zeros_like(v.narrow(a, 0, 1))
                parts.append(torch.cat([wall, inner, wall, -inner.flip(a)], a))
            else:
                parts.append(torch.cat([v, v.flip(a)], a))
        u = torch.cat(parts, 1)
    return (
        u,
        tuple("periodic" if end == "slip" else end for end in boundary),
        tuple(2 * side if end == "slip" else side for side, end in zip(length, boundary, strict=True)),
    )


def half(u, shape):
    for axis, n in enumerate(shape):
        u = u.narrow(axis + 2, 0, n)
    return u


CASES = [
    ((6, 7), ("slip", "slip")),
    ((6, 7), ("slip", "periodic")),
    ((7, 6), ("wall", "slip")),
    ((6, 8), ("slip", "open")),
    ((4, 5, 6), ("slip", "wall", "periodic")),
    ((4, 5, 3), ("slip", "slip", "slip")),
]


@pytest.mark.parametrize("nu", [0.02, 3.0], ids=["low viscosity", "high viscosity"])
@pytest.mark.parametrize("advection", ["central", "upwind"])
@pytest.mark.parametrize("diffusion", ["implicit", "explicit"])
@pytest.mark.parametrize("shape, boundary", CASES)
def test_it_is_half_of_a_mirrored_flow(shape, boundary, diffusion, advection, nu):
    d, dt = len(shape), 0.004
    length = (1.0, 1.3, 0.8)[:d]
    if diffusion == "explicit":
        nu = min(nu, 0.3)
    settings = {"nu": nu, "dt": dt, "diffusion": diffusion, "advection": advection}
    settings["solver"] = prdp.CG(500, rtol=1e-13, preconditioner="multigrid")
    u, force = 0.3 * noise(2, d, *shape, seed=1), noise(2, d, *shape, seed=2)
    whole, ends, sides = mirrored(u, boundary, length)
    inflow = {}
    if "open" in boundary:
        inflow = {"inflow": torch.tensor([0.7, 0.0], dtype=F64)}
    mine = prdp.Flow(shape, boundary=boundary, length=length, force=force, **inflow, **settings)
    other_force = mirrored(force, boundary, length)[0]
    other = prdp.Flow(whole.shape[2:], boundary=ends, length=sides, force=other_force, **inflow, **settings)
    u.requires_grad_()
    states, others = mine.rollout(u, 3), other.rollout(mirrored(u, boundary, length)[0], 3)
    for step in range(1, 4):
        torch.testing.assert_close(states[:, step], half(others[:, step], shape), rtol=1e-9, atol=1e-10)
    weights = noise(*states[:, -1].shape, seed=3)
    (grad,) = torch.autograd.grad((weights * states[:, -1]).sum(), u)
    (expected,) = torch.autograd.grad((weights * half(others[:, -1], shape)).sum(), u)
    torch.testing.assert_close(grad, expected, rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(mine.divergence(states[:, 1]), torch.zeros_like(states[:, 1, :1]), rtol=0, atol=1e-8)


@pytest.mark.parametrize("solver", [prdp.CG(200, preconditioner="multigrid", rtol=1e-12), prdp.Direct()])
def test_vortices_decay_at_second_order_towards_the_exact_rate(solver):
    """u = sin x cos y, v = -cos x sin y between x, y = 0 and π meets the walls as it is."""
    nu, final, errors = 0.1, 0.2, []
    for n in (16, 32):
        u = torch.stack(
            [
                torch.sin(x) * torch.cos(y) if c == 0 else -torch.cos(x) * torch.sin(y)
                for c in range(2)
                for x, y in [positions((n, n), c, math.pi)]
            ]
        )[None]
        steps = n * n // 8
        flow = prdp.Flow((n, n), nu=nu, dt=final / steps, boundary="slip", length=math.pi, solver=solver)
        after = flow.rollout(u, steps)[:, -1]
        exact = math.exp(-2 * nu * final) * u
        errors.append(((after - exact).norm() / exact.norm()).item())
    assert errors[0] < 1e-3 and errors[0] / errors[1] > 3.7


def test_a_uniform_stream_along_them_stays():
    flow = prdp.Flow((8, 6), nu=0.5, dt=0.1, boundary=("slip", "periodic"))
    u = torch.zeros(1, 2, 8, 6)
    u[:, 0] = 0.5
    assert torch.allclose(flow.rollout(u, 20)[:, -1], u, atol=1e-6)
    held = prdp.Flow((8, 6), nu=0.5, dt=0.1, boundary=("wall", "periodic"))
    assert held.rollout(u, 20)[:, -1].abs().max() < 1e-3


def test_what_is_refused():
    with pytest.raises(ValueError, match="is on an axis whose boundary is not 'wall'"):
        prdp.Flow((8, 8), nu=0.1, dt=0.01, boundary="slip", wall_velocity={(0, "high"): 1.0})
    with pytest.raises(ValueError, match="boundary must be 'periodic', 'wall', 'slip' or 'open', got 'free'"):
        prdp.Flow((8, 8), nu=0.1, dt=0.01, boundary="free")
    flow = prdp.Flow((8, 8), nu=1e6, dt=1.0, boundary=("slip", "periodic"))
    with pytest.raises(ValueError, match="float32 loses the mean velocity"):
        flow(torch.zeros(1, 2, 8, 8))
    prdp.Flow((8, 8), nu=1e6, dt=1.0, boundary="slip")(torch.zeros(1, 2, 8, 8))
