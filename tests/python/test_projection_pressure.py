"""The forms of the pressure of `Flow`: steady flows, the order in time, and steps of any length."""

import pytest
import torch
from flows import random_velocity
from hypothesis import given, settings
from hypothesis import strategies as st

import prdp_torch as prdp

EXACT = prdp.CG(300, rtol=1e-11, preconditioner="multigrid")


def steady(flow, u, steps=2000):
    with torch.no_grad():
        for _ in range(steps // 20):
            before, u = u, flow.rollout(u, 20)[:, -1]
            if (u - before).abs().max() < 1e-10:
                return u
    raise AssertionError("not steady")


def channel(per_cell, pressure):
    """Poiseuille flow with an inflow that is exact for the difference quotients, and nu dt/dx² = per_cell."""
    n, m = 16, 24
    y = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    inflow = torch.zeros(1, 2, n, 1, dtype=torch.float64)
    inflow[0, 0, :, 0] = 4 * (y * (1 - y) + 0.25 / n**2)
    flow = prdp.Flow((n, m), 1.0, per_cell / n**2, ("wall", "open"), (1.0, m / n), inflow=inflow, pressure=pressure,
                     solver=EXACT)  # fmt: skip
    u = steady(flow, 0.5 * inflow.expand(1, 2, n, m))
    p = flow.pressure(u)[0, 0]
    return (n * (p[:, 1:-1] - p[:, :-2])), u - inflow


@pytest.mark.parametrize("per_cell", [0.5, 3.8])
def test_a_steady_channel_keeps_its_pressure(per_cell):
    gradient, change = channel(per_cell, "incremental")
    assert (gradient + 8).abs().max() < 1e-5
    assert change.abs().max() < 1e-7
    gradient, change = channel(per_cell, "plain")
    assert (gradient + 8).abs().max() > 0.2 and change.abs().max() > 0.01


def cavity(dt, n=8, nu=0.2, **options):
    solid = torch.zeros(n, n, dtype=torch.bool)
    solid[2:4, 3] = True
    return prdp.Flow((n, n), nu, dt, boundary="wall", wall_velocity={(0, "high"): 1.0}, obstacle=solid, solver=EXACT,
                     **options)  # fmt: skip


@pytest.mark.parametrize("per_cell", [1.0, 1.2])  # 1.25 is the bound with an obstacle
def test_steady_flows_do_not_depend_on_the_time_step(per_cell):
    u = torch.zeros(1, 2, 8, 8, dtype=torch.float64)
    expected = steady(cavity(0.01, diffusion="explicit"), u)
    dt = per_cell / 64 / 0.2
    torch.testing.assert_close(steady(cavity(dt), u), expected, rtol=0, atol=1e-8)
    assert (steady(cavity(dt, pressure="plain"), u) - expected).abs().max() > 5e-3


def test_a_force_that_the_pressure_balances_moves_nothing():
    """In a closed box with an obstacle, from rest: a gradient as the force."""
    x = torch.linspace(0, 1, 9, dtype=torch.float64)[:-1]
    force = torch.stack([torch.cos(3 * x).expand(8, 8), (x**2)[:, None].expand(8, 8)])[None]
    flow = cavity(0.09, force=force)
    flow.wall_velocity = None
    assert flow.rollout(torch.zeros(1, 2, 8, 8, dtype=torch.float64), 3).abs().max() < 1e-11


def test_the_error_in_time_is_of_first_order_and_less_than_with_the_plain_form():
    u = cavity(0.01).project(torch.zeros(1, 2, 8, 8, dtype=torch.float64))
    with torch.no_grad():
        exact = 2 * cavity(1e-4, diffusion="explicit").rollout(u, 1200)[:, -1]
        exact = exact - cavity(2e-4, diffusion="explicit").rollout(u, 600)[:, -1]  # extrapolated to dt = 0
        errors = {
            form: [
                (cavity(0.12 / steps, pressure=form).rollout(u, steps)[:, -1] - exact).abs().max().item()
                for steps in (6, 12, 24)
            ]
            for form in ("incremental", "plain")
        }
    of_incremental, of_plain = errors["incremental"], errors["plain"]
    assert 1.6 < of_incremental[0] / of_incremental[1] < 2.6 and 1.6 < of_incremental[1] / of_incremental[2] < 2.6
    assert all(a < 0.5 * b for a, b in zip(of_incremental, of_plain, strict=True))


@pytest.mark.parametrize("options", [{}, {"diffusion": "explicit", "boundary": "wall"}])
def test_the_forms_are_the_same_without_walls_and_with_explicit_diffusion(options):
    u = 0.1 * random_velocity((8, 6))
    plain, incremental = (
        prdp.Flow((8, 6), 0.1, 0.01, pressure=form, **options)(u) for form in ("plain", "incremental")
    )
    assert torch.equal(plain, incremental)


KINDS = st.sampled_from(["periodic", "wall", "open"])


@settings(max_examples=60, deadline=None)
@given(
    kinds=st.tuples(KINDS, KINDS).filter(lambda kinds: kinds.count("open") < 2),
    sides=st.tuples(st.floats(-1.5, 0), st.floats(-1.5, 0)),
    per_cell=st.sampled_from([0.5, 2.0, 4.0, 4.5, 6.0, 16.0, 100.0, 1e4]),
    solid=st.floats(0, 0.5),
    seed=st.integers(0, 2**31),
)
def test_no_step_is_too_long_for_the_diffusion(kinds, sides, per_cell, solid, seed):
    """The energy of a slow flow falls, around any obstacle, on cells of any shape."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(7, 6, generator=generator) < solid
    if "open" in kinds:
        mask[:] = False
    if mask.all():
        return
    length = tuple(10**side for side in sides)
    least = min(length[0] / 7, length[1] / 6)
    inflow = (0.0, 0.0) if "open" in kinds else None
    solver = prdp.CG(500, rtol=1e-9, preconditioner="diagonal")
    flow = prdp.Flow((7, 6), 1.0, per_cell * least**2, kinds, length, mask, inflow=inflow, solver=solver)
    u = flow.project(1e-6 * least / flow.dt * random_velocity((7, 6), seed=seed))
    energies = flow.rollout(u, 8).square().sum((0, 2, 3, 4))
    assert (energies[1:] <= (1 + 1e-6) * energies[:-1] + 1e-12 * energies[0]).all()


def test_the_form_is_named():
    with pytest.raises(ValueError, match="Flow: pressure must be 'incremental' or 'plain', got 'rotational'"):
        prdp.Flow((8, 6), 0.1, 0.01, pressure="rotational")


@pytest.mark.parametrize("shape", [(12, 12), (6, 8, 10)])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_the_pressure_of_a_periodic_box_does_not_depend_on_how_diffusion_is_solved(shape, backward):
    """Where the velocity has no divergence, it is that of explicit diffusion, whose steps need no stability here."""
    boxes = [
        prdp.Flow(shape, 0.02, 1e-3, solver=EXACT, diffusion=diffusion, backward=backward)
        for diffusion in ["implicit", "explicit"]
    ]
    u = boxes[0].project(random_velocity(shape))
    implicit, explicit = (flow.pressure(u) for flow in boxes)
    torch.testing.assert_close(implicit, explicit, rtol=0, atol=1e-8 * explicit.abs().max().item())


def test_gradients_of_the_pressure_of_a_periodic_box():
    u = random_velocity((6, 6))
    nu = torch.tensor(0.3, dtype=torch.float64)

    def pressure(u, nu):
        return prdp.Flow((6, 6), nu, 0.02, solver=prdp.Direct()).pressure(u)

    assert torch.autograd.gradcheck(pressure, (u.requires_grad_(), nu.requires_grad_()))
