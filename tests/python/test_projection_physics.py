"""`Flow` against closed solutions."""

import math

import pytest
import torch
from flows import positions, random_velocity, taylor_green

import prdp_torch as prdp

EXACT = prdp.CG(200, rtol=1e-12, preconditioner="multigrid")


def taylor_green_error(n, dt, steps, nu=0.05, **options):
    flow = prdp.Flow((n, n), nu, dt, length=2 * math.pi, solver=EXACT, **options)
    u = start = taylor_green(n)
    with torch.no_grad():
        for _ in range(steps):
            u = flow(u)
    exact = start * math.exp(-2 * nu * dt * steps)
    return ((u - exact).norm() / exact.norm()).item()


@pytest.mark.parametrize("diffusion", ["implicit", "explicit"])
def test_the_taylor_green_vortex_decays_with_second_order(diffusion):
    coarse, fine = (taylor_green_error(n, 1e-3, 200, diffusion=diffusion) for n in (32, 64))
    assert coarse / fine > 3
    assert fine < 2e-3


def test_errors_in_time_are_of_first_order():
    long, short = (taylor_green_error(128, 0.4 / steps, steps, nu=0.5) for steps in (10, 20))
    assert 1.7 < long / short < 2.3


def test_upwind_advection_converges():
    coarse, fine = (taylor_green_error(n, 5e-3, 40, advection="upwind") for n in (16, 64))
    assert coarse / fine > 3
    assert fine < 0.05


@pytest.mark.parametrize("n", [8, 24])
def test_poiseuille_flow_between_walls(n):
    """Without pressure gradient but with a force: u = f/(2 nu) y (1 - y)."""
    nu, force = 0.5, 4.0
    flow = prdp.Flow(
        (n, 4), nu, 0.5, boundary=("wall", "periodic"), length=(1.0, 4 / n), force=(force, 0.0), solver=EXACT
    )
    u = torch.zeros(1, 2, n, 4, dtype=torch.float64)
    with torch.no_grad():
        for _ in range(60):
            u = flow(u)
    _, y = positions((n, 4), 0)
    exact = force / (2 * nu) * y * (1 - y)
    assert (u[0, 0] - exact).norm() / exact.norm() < 5e-3 * (24 / n) ** 2
    assert u[0, 1].abs().max() < 1e-12


@pytest.mark.parametrize("shape", [(12, 10), (6, 5, 7)])
@pytest.mark.parametrize("boundary", ["periodic", "wall", "open", "mixed"])
def test_a_projected_velocity_has_no_divergence_and_stays_itself(shape, boundary):
    d = len(shape)
    kinds = {"mixed": ["wall", "periodic", "open"][-d:], "open": ["wall"] * (d - 1) + ["open"]}.get(
        boundary, [boundary] * d
    )
    inflow = torch.linspace(1, 2, d, dtype=torch.float64) if "open" in kinds else None
    flow = prdp.Flow(shape, 0.1, 1e-3, boundary=kinds, inflow=inflow, solver=EXACT)
    u = random_velocity(shape, batch=2)
    projected = flow.project(u)
    assert flow.divergence(u).abs().max() > 1
    assert flow.divergence(projected).abs().max() < 1e-8
    torch.testing.assert_close(flow.project(projected), projected, rtol=0, atol=1e-9)
    assert flow.divergence(flow(0.1 * projected)).abs().max() < 1e-8


def test_the_projection_is_the_nearest_velocity():
    """What is taken off is orthogonal to all velocities without divergence."""
    flow = prdp.Flow((9, 8), 0.1, 1e-3, boundary=("wall", "periodic"), solver=EXACT)
    u, v = random_velocity((9, 8), batch=2)[:, None]
    u = torch.where(torch.arange(9)[:, None] > 0, u, u * torch.tensor([1.0, 0.0])[:, None, None])  # zero on the wall
    assert ((u - flow.project(u)) * flow.project(v)).sum().abs() < 1e-10


def test_the_pressure_balances_a_force_that_walls_hold():
    """A force along y between walls: hydrostatic pressure, and nothing moves."""
    walls = ("wall", "periodic")
    flow = prdp.Flow((16, 4), 0.1, 1e-3, boundary=walls, force=(0.0, -3.0), diffusion="explicit", solver=EXACT)
    u = torch.zeros(1, 2, 16, 4, dtype=torch.float64)
    y = (torch.arange(16, dtype=torch.float64) + 0.5) / 16
    torch.testing.assert_close(flow.pressure(u), (3.0 * (0.5 - y))[:, None].expand(1, 1, 16, 4), rtol=0, atol=1e-10)
    assert flow(u).abs().max() < 1e-12


def test_central_advection_conserves_the_energy():
    """Of any velocity, with divergence too: the form is skew-symmetric."""
    u = random_velocity((8, 6))
    rate = []
    for dt in (1e-5, 1e-6):
        flow = prdp.Flow((8, 6), 0.0, dt, diffusion="explicit", solver=EXACT)
        v = flow.project(u)
        rate.append(((flow(v) ** 2).sum() - (v**2).sum()).item() / dt / (v**2).sum().item())
    assert abs(rate[1]) < 0.2 * abs(rate[0]) + 1e-6  # what is left is the error in time


def test_a_vortex_is_carried_along():
    """Channel 0 is the velocity along x, the last axis."""
    u = taylor_green(64) + 0.5
    flow = prdp.Flow((64, 64), 0.05, 1e-3, length=2 * math.pi, solver=EXACT)
    x, y = positions((64, 64), 0, 2 * math.pi)
    step = (flow(u) - u)[0, 0] / 1e-3
    # u_t = -(0.5 ∂x + 0.5 ∂y) u - 2 nu (u - 0.5) for the vortex that is carried along
    expected = (
        -0.5 * torch.cos(x) * torch.cos(y) + 0.5 * torch.sin(x) * torch.sin(y) - 0.1 * torch.sin(x) * torch.cos(y)
    )
    assert (step - expected).abs().max() < 0.01
