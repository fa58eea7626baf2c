"""Steps of `Flow` that are accepted do not blow up: slow flows decay, and small waves on a wind do not grow."""

import pytest
import torch
from flows import random_velocity

import prdp_torch as prdp


def growth(flow, u, base=None, steps=30):
    """How much the distance from `base`, which is a steady flow, grows per step in the end."""
    base = torch.zeros_like(u) if base is None else base
    distances = []
    for _ in range(steps):
        u = flow(u)
        distances.append((u - base).norm())
    return ((distances[-1] / distances[-11]) ** 0.1).item()


def plate(shape, thickness):
    """Across the last axis, with a hole of one cell."""
    solid = torch.zeros(shape, dtype=torch.bool)
    solid[..., shape[-1] // 2 :][..., :thickness] = True
    solid[(0,) * (len(shape) - 1)] = False
    return solid


EXACT = prdp.Direct()
ITERATED = prdp.CG(400, rtol=1e-8, preconditioner="multigrid")
THROATS = {  # shape, length, thickness, boundary
    "square cells": ((8, 32), (8.0, 32.0), 4, "periodic", EXACT),
    "long": ((6, 96), (6.0, 96.0), 16, "periodic", ITERATED),
    "walls": ((16, 32), (16.0, 32.0), 4, ("wall", "periodic"), EXACT),
    "stretched cells": ((8, 16), (8.0, 160.0), 2, "periodic", EXACT),
    "3D": ((3, 3, 48), (3.0, 3.0, 48.0), 8, "periodic", ITERATED),
}


@pytest.mark.parametrize("number", [1.0, 1.5, 3.0, 4.0, 8.0, 16.0])
@pytest.mark.parametrize("throat", THROATS)
def test_a_slow_flow_through_a_throat_decays(throat, number):
    """With all of its drag in the pressure, it grew up to five times in each step from a nu dt/dx² of 1.5 or 3 on."""
    shape, length, thickness, boundary, solver = THROATS[throat]
    flow = prdp.Flow(shape, 1.0, number, boundary, length, plate(shape, thickness), solver=solver)
    slow = flow.project(1e-30 * random_velocity(shape))
    assert growth(flow, slow) < 1


@pytest.mark.parametrize("number", [1.25, 2.0, 3.0, 4.0, 6.0, 16.0])
@pytest.mark.parametrize("boundary", [("wall", "open"), "wall", ("wall", "periodic")])
def test_a_slow_flow_around_a_block_near_a_wall_decays(boundary, number):
    solid = torch.zeros(31, 60, dtype=torch.bool)
    solid[21:30, 20:24] = True
    rest = {"inflow": [0.0, 0.0]} if "open" in boundary else {}
    flow = prdp.Flow((31, 60), number, 1.0, boundary, (31.0, 60.0), solid, solver=EXACT, **rest)
    assert growth(flow, flow.project(1e-30 * random_velocity((31, 60)))) < 1


@pytest.mark.parametrize("number", [1.25, 2.0, 4.0, 8.0])
def test_a_slow_flow_through_a_winding_throat_on_stretched_cells_decays(number):
    solid = torch.zeros(3, 40, dtype=torch.bool)
    solid[1:, 0] = solid[:2, 2] = True  # two plates, with holes at opposite ends
    flow = prdp.Flow((3, 40), number / 16, 1.0, ("wall", "periodic"), (3.0, 10.0), solid, solver=EXACT)
    assert growth(flow, flow.project(1e-30 * random_velocity((3, 40)))) < 1


def test_an_obstacle_without_a_solid_cell_is_none():
    u = 1e-3 * random_velocity((8, 8))
    options = {"boundary": ("wall", "periodic"), "length": 8.0, "solver": EXACT}
    with_mask = prdp.Flow((8, 8), 2.0, 1.0, obstacle=torch.zeros(8, 8, dtype=torch.bool), **options)
    assert torch.equal(with_mask(u), prdp.Flow((8, 8), 2.0, 1.0, **options)(u))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("stretched", [1.0, 3.0, 10.0])
def test_an_accepted_wind_along_long_or_short_cells_lets_no_wave_grow(axis, stretched):
    n, dt = 16, 1.0
    length = (n * 0.1, n * 0.1 * stretched)
    nu = 16 * 0.1**2 / dt
    flow = prdp.Flow((n, n), nu, dt, length=length, solver=EXACT)
    speed = torch.zeros(1, 2, 1, 1, dtype=torch.float64)
    largest = max(1.0, (2 * nu * dt) ** 0.5 / max(length) * n)
    speed[0, 1 - axis] = 0.99 * largest * length[axis] / n / dt
    wind = speed.expand(1, 2, n, n)
    u = flow.project(wind + 1e-9 * random_velocity((n, n)))
    if largest > 1:
        assert growth(flow, u, wind) < 1
    with pytest.raises(torch.linalg.LinAlgError, match=r"DIVERGED: dt Σ \|u\|/dx is .* needs at most"):
        flow(flow.project(1.03 * wind))


@pytest.mark.parametrize(("courant", "diffused"), [(0.3, 0.65), (0.5, 0.45), (0.9, 0.05)])
def test_explicit_upwind_steps_need_both_numbers_together_below_one(courant, diffused):
    n, dt = 16, courant / 16
    wind = torch.tensor([1.0, 0.0], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, n, n)

    def flow(number):
        options = {"diffusion": "explicit", "advection": "upwind", "solver": EXACT}
        return prdp.Flow((n, n), number / n**2 / 4 / dt, dt, **options)

    good, bad = flow(diffused), flow(1.01 - courant)
    u = good.project(wind + 1e-9 * random_velocity((n, n)))
    assert growth(good, u, wind) <= 1.001
    with pytest.raises(torch.linalg.LinAlgError, match="needs at most"):
        bad(u)
