"""Walls of `Flow` that move along themselves, against closed solutions, the published cavity and differences."""

import copy
import math
import re

import pytest
import torch
from flows import positions, random_velocity
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp

EXACT = prdp.CG(200, rtol=1e-13, preconditioner="multigrid")
FORMS = {
    "explicit": {"diffusion": "explicit"},
    "incremental": {},
    "plain": {"pressure": "plain"},
    "upwind": {"advection": "upwind"},
}
CHANNELS = {2: {0: (0,), 1: (1,)}, 3: {0: (0, 1), 1: (0, 2), 2: (1, 2)}}  # the components along the walls of an axis


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape, axis", [((7, 4), 0), ((4, 7), 1), ((6, 3, 4), 0), ((3, 6, 4), 1), ((3, 4, 6), 2)])
def test_couette_flow_between_walls_of_two_speeds_stays_as_it_is(shape, axis, form):
    """Linear between the walls: the difference quotients are exact."""
    d, n = len(shape), shape[axis]
    low, high = torch.zeros(d, dtype=torch.float64), torch.zeros(d, dtype=torch.float64)
    for channel in CHANNELS[d][axis]:
        low[channel], high[channel] = 0.3 + channel, -0.5
    kinds = ["periodic"] * d
    kinds[axis] = "wall"
    walls = {(axis, "low"): low, (axis, "high"): high}
    flow = prdp.Flow(shape, 0.1, 0.01, boundary=kinds, wall_velocity=walls, solver=EXACT, **FORMS[form])
    way = ((torch.arange(n, dtype=torch.float64) + 0.5) / n).view(-1, *(1,) * (d - 1 - axis))
    u = torch.stack([(low[c] + (high[c] - low[c]) * way).expand(shape) for c in range(d)])[None]
    torch.testing.assert_close(flow.rollout(u, 3)[:, -1], u, rtol=0, atol=1e-12)


def started(dt, **options):
    """The error of a fluid at rest whose lid begins to move, at t = 0.1 with nu = 1: the series of Fourier."""
    n = 32
    flow = prdp.Flow((n, 4), 1.0, dt, ("wall", "periodic"), (1.0, 4 / n), wall_velocity={(0, "high"): 1.0}, **options)
    u = flow.rollout(torch.zeros(1, 2, n, 4, dtype=torch.float64), round(0.1 / dt))[0, -1]
    _, y = positions((n, 4), 0)
    waves = ((-1) ** k / (k * math.pi) * math.exp(-((k * math.pi) ** 2) * 0.1) * torch.sin(k * math.pi * y)
             for k in range(1, 20))  # fmt: skip
    return (u[0] - y - 2 * sum(waves)).abs().max().item()


@pytest.mark.parametrize("pressure", ["incremental", "plain"])
def test_a_lid_that_begins_to_move(pressure):
    long, short = started(0.005, pressure=pressure), started(0.0025, pressure=pressure)
    assert short < 4e-3 and 1.7 < long / short < 2.3
    assert started(0.0002, diffusion="explicit") < 4e-4


# For each Re: u at the heights y above the middle of the floor, v at the places x along the middle; and the cells, the
# time step, the steps and the largest difference of a coarse computation.
GHIA = {
    100: (
        {0.0625: -0.04192, 0.1719: -0.10150, 0.2813: -0.15662, 0.5: -0.20581, 0.7344: 0.00332, 0.9531: 0.68717},
        {0.0625: 0.09233, 0.1563: 0.16077, 0.2266: 0.17507, 0.5: 0.05454, 0.8047: -0.24533, 0.9531: -0.08864},
        (24, 0.02, 800, 0.009),
    ),
    400: (
        {0.0625: -0.09266, 0.1719: -0.24299, 0.2813: -0.32726, 0.5: -0.11477, 0.7344: 0.16256, 0.9531: 0.55892},
        {0.0625: 0.18360, 0.1563: 0.28124, 0.2266: 0.30203, 0.5: 0.05186, 0.8047: -0.38598, 0.9531: -0.19254},
        (32, 0.01, 2500, 0.04),
    ),
}


@pytest.mark.parametrize("reynolds, form", [(100, "explicit"), (100, "incremental"), (400, "explicit")])
def test_the_lid_driven_cavity_of_ghia_ghia_and_shin(reynolds, form):
    of_u, of_v, (n, dt, steps, most) = GHIA[reynolds]
    flow = prdp.Flow((n, n), 1 / reynolds, dt, boundary="wall", wall_velocity={(0, "high"): 1.0}, **FORMS[form])
    with torch.no_grad():
        u = flow.rollout(torch.zeros(1, 2, n, n), steps)[0, -1].double()
    across, along = u[0, :, n // 2], u[1, n // 2]  # both on the lines through the centre, as n is even
    for found, values, top in ((across, of_u, 1.0), (along, of_v, 0.0)):
        row = torch.cat([-found[:1], found, 2 * top - found[-1:]])
        for place, value in values.items():
            at, part = divmod(place * n + 0.5, 1.0)
            assert row[int(at)] + part * (row[int(at) + 1] - row[int(at)]) == pytest.approx(value, abs=most)
    assert flow.divergence(u[None]).abs().max() < 1e-3


def test_all_sides_are_alike():
    """A lid at one side is that at another in a mirror."""
    n = 8
    u = 0.1 * random_velocity((n, n))

    def mirrored(t):  # y -> -y: faces move by one, and v changes its sign
        v = torch.cat([torch.zeros(1, 1, n, dtype=t.dtype), -t[:, 1, 1:].flip(1)], 1)
        return torch.stack([t[:, 0].flip(1), v], 1)

    def transposed(t):
        return t.transpose(-1, -2).flip(1)

    def step(side, state):
        return prdp.Flow((n, n), 0.1, 0.01, boundary="wall", wall_velocity={side: 0.7}, solver=EXACT)(state)

    u = prdp.Flow((n, n), 0.1, 0.01, boundary="wall", solver=EXACT).project(u)
    high = step((0, "high"), u)
    torch.testing.assert_close(mirrored(step((0, "low"), mirrored(u))), high, rtol=0, atol=1e-12)
    torch.testing.assert_close(transposed(step((1, "high"), transposed(u))), high, rtol=0, atol=1e-12)
    assert (high - step((1, "low"), u)).abs().max() > 0.01


def test_a_number_a_vector_a_field_and_a_tensor_of_one_value_are_the_same():
    u = 0.1 * random_velocity((5, 6), batch=2)
    field = torch.zeros(2, 2, 6, dtype=torch.float64)
    field[:, 0] = 0.7
    ways = (0.7, (0.7, 0.0), field, torch.tensor(0.7, dtype=torch.float64), field[:1])
    steps = [prdp.Flow((5, 6), 0.1, 0.01, boundary="wall", wall_velocity={(0, "low"): way})(u) for way in ways]
    for other in steps[1:]:
        assert torch.equal(steps[0], other)


CASES = {
    "cavity": {"shape": (4, 5), "boundary": "wall"},
    "open": {"shape": (5, 6), "boundary": ("wall", "open"), "inflow": (1.0, 0.1), "obstacle": (2, 2)},
    "coarse": {"shape": (4, 5), "boundary": "wall", "nu": 30.0},
    "3d": {"shape": (3, 4, 3), "boundary": ("wall", "wall", "periodic"), "obstacle": (1, 2, 1)},
}


def make(name, walls, nu=None, **options):
    case = {**CASES[name], **options}
    shape = case.pop("shape")
    if "obstacle" in case:
        solid = torch.zeros(shape, dtype=torch.bool)
        solid[case["obstacle"]] = True
        case["obstacle"] = solid
    if nu is not None:
        case["nu"] = nu
    sides = [(axis, end) for axis, kind in enumerate(kinds_of(name)) for end in ("low", "high") if kind == "wall"]
    moving = dict(zip(sides, walls, strict=True))
    options = {"solver": EXACT, "adjoint_rtol": None if "backward" in options else 1e-13}
    return prdp.Flow(shape, case.pop("nu", 0.3), 0.02, wall_velocity=moving, **{**options, **case})


def kinds_of(name):
    kinds, shape = CASES[name]["boundary"], CASES[name]["shape"]
    return kinds if isinstance(kinds, tuple) else (kinds,) * len(shape)


def walls_of(name, batch=2):
    """One field for each sample, one for all, or one vector, in turn."""
    shape, found = CASES[name]["shape"], []
    d = len(shape)
    for axis, kind in enumerate(kinds_of(name)):
        for end in range(2 if kind == "wall" else 0):
            side = shape[:axis] + shape[axis + 1 :]
            sizes = [(batch, d, *side), (1, d, *side), (d,)][(axis + end) % 3]
            value = torch.randn(sizes, dtype=torch.float64)
            value.select(0 if value.dim() == 1 else 1, d - 1 - axis).zero_()
            found.append(value.requires_grad_())
    return found


def along(name, walls):
    """Differences move the normal component as well, which must be 0."""
    axes = [axis for axis, kind in enumerate(kinds_of(name)) for _ in range(2 if kind == "wall" else 0)]
    d, masked = len(CASES[name]["shape"]), []
    for axis, value in zip(axes, walls, strict=True):
        mask = torch.ones(d, dtype=torch.float64)
        mask[d - 1 - axis] = 0
        masked.append(value * mask.view(-1, *(1,) * max(0, value.dim() - 2)))
    return masked


@pytest.mark.parametrize("diffusion", ["implicit", "explicit"])
@pytest.mark.parametrize("name", CASES)
def test_a_step_and_its_pressure_have_the_gradients_of_finite_differences(name, diffusion):
    torch.manual_seed(0)
    nu = torch.tensor(CASES[name].get("nu", 0.3), dtype=torch.float64, requires_grad=True)

    def both(u, nu, *walls):
        nu = 0.003 * nu if diffusion == "explicit" else nu
        return make(name, along(name, walls), nu=nu, diffusion=diffusion).step_and_pressure(u)

    u = random_velocity(CASES[name]["shape"], batch=2).requires_grad_()
    assert gradcheck(both, (u, nu, *walls_of(name)), fast_mode=name == "3d")


def test_rollouts_and_second_derivatives():
    torch.manual_seed(0)
    u = random_velocity((4, 5)).requires_grad_()
    walls = walls_of("cavity", batch=1)

    def states(u, *walls):
        return make("cavity", along("cavity", walls)).rollout(u, 2)

    assert gradcheck(states, (u, *walls), fast_mode=True) and gradgradcheck(states, (u, *walls), fast_mode=True)


def test_unrolled_gradients():
    torch.manual_seed(0)
    few = prdp.CG(2, rtol=0.0, preconditioner="diagonal")

    def step(u, *walls):
        return make("cavity", along("cavity", walls), solver=few, backward="unrolled")(u)

    u = random_velocity((4, 5), batch=2).requires_grad_()
    assert gradcheck(step, (u, *walls_of("cavity")), fast_mode=True)


@pytest.mark.parametrize("name", CASES)
def test_loops_and_tensor_operations_make_the_same_step(name):
    torch.manual_seed(0)
    u, walls = random_velocity(CASES[name]["shape"], batch=2), walls_of(name)
    recorded = make(name, walls, backward="unrolled")(u).detach()
    with torch.no_grad():
        torch.testing.assert_close(make(name, walls)(u), recorded, rtol=1e-11, atol=1e-11)


def test_a_lid_is_found_from_the_flow_that_it_drives():
    """A Parameter is one of the module, and trained."""
    true = prdp.Flow((8, 8), 0.1, 0.02, boundary="wall", wall_velocity={(0, "high"): 0.6})
    flow = prdp.Flow((8, 8), 0.1, 0.02, boundary="wall",
                     wall_velocity={(0, "high"): torch.nn.Parameter(torch.tensor(0.1))})  # fmt: skip
    start = torch.zeros(1, 2, 8, 8)
    target = true.rollout(start, 5)[:, -1]
    optimiser = torch.optim.LBFGS(flow.parameters(), line_search_fn="strong_wolfe")

    def loss():
        optimiser.zero_grad()
        value = (flow.rollout(start, 5)[:, -1] - target).square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    assert [name for name, _ in flow.named_parameters()] == ["wall_velocity_0_high"]
    assert flow.wall_velocity[0, "high"].item() == pytest.approx(0.6, abs=1e-3)
    assert set(flow.state_dict()) == {"wall_velocity_0_high"}
    assert copy.deepcopy(flow).wall_velocity[0, "high"].item() == flow.wall_velocity[0, "high"].item()


def test_a_wall_may_be_set_for_each_step():
    u = torch.zeros(1, 2, 6, 5)
    flow = prdp.Flow((6, 5), 0.1, 0.01, boundary="wall")
    rest = flow(u)
    for speed in (0.3, torch.tensor(0.3, requires_grad=True).square().sqrt()):
        flow.wall_velocity = {(1, "low"): speed}
        expected = prdp.Flow((6, 5), 0.1, 0.01, boundary="wall", wall_velocity={(1, "low"): 0.3})(u)
        torch.testing.assert_close(flow(u), expected)
    with pytest.raises(TypeError):
        flow.wall_velocity[1, "low"] = 0.5  # a view; it would have no effect
    flow.wall_velocity = None
    assert torch.equal(flow(u), rest) and not flow.wall_velocity


WALLS = {"boundary": ("wall", "periodic")}
BAD = {
    "no dict": (1.0, TypeError, "wall_velocity must be a dict such as {(0, 'high'): 1.0}, got 1.0"),
    "axis": ({(2, "low"): 1.0}, ValueError, "must be (axis, 'low' or 'high') with an axis below 2, got (2, 'low')"),
    "end": ({(0, "top"): 1.0}, ValueError, "must be (axis, 'low' or 'high') with an axis below 2, got (0, 'top')"),
    "word": ({(0, "low"): "fast"}, TypeError, "wall_velocity must be a real number, got 'fast'"),
    "periodic": ({(1, "low"): 1.0}, ValueError, "wall_velocity of side (1, 'low') is on an axis whose boundary is not"),
    "through": ({(0, "high"): (1.0, 0.5)}, ValueError, "side (0, 'high') must be along the wall: its component 1 must"),
    "shape": (
        {(0, "low"): torch.zeros(1, 2, 8)},
        ValueError,
        "wall_velocity of side (0, 'low') must have shape (2,) or (batch or 1, 2, 6), got [1, 2, 8]",
    ),
    "whole numbers": ({(0, "low"): torch.zeros(2, dtype=torch.int64)}, TypeError, "must hold real numbers, got int64"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_walls_are_named_before_any_work(name):
    walls, kind, message = BAD[name]
    with pytest.raises(kind, match=re.escape(message)):
        prdp.Flow((8, 6), 0.1, 0.01, **WALLS, wall_velocity=walls)


def test_walls_that_do_not_fit_the_state_or_are_not_finite_are_named():
    with pytest.raises(ValueError, match="a number as wall_velocity is for 2D"):
        prdp.Flow((8, 6, 4), 0.1, 0.01, boundary="wall", wall_velocity={(0, "high"): 1.0})
    field = torch.zeros(3, 2, 6)
    flow = prdp.Flow((8, 6), 0.1, 0.01, **WALLS, wall_velocity={(0, "high"): field})
    with pytest.raises(ValueError, match=r"wall_velocity of side \(0, 'high'\) holds 3 samples, u holds 2"):
        flow(torch.zeros(2, 2, 8, 6))
    field[1, 0, 4] = torch.nan
    words = r"1 of 3 samples failed: sample 1 NONFINITE_INPUT: wall_velocity of side \(0, 'high'\) is not finite at "
    with pytest.raises(torch.linalg.LinAlgError, match=words + r"index \(0, 4\)"):
        flow(torch.zeros(3, 2, 8, 6))
    flow.on_failure = "zero_grad"
    u = (0.1 * random_velocity((8, 6), dtype=torch.float32)).repeat(3, 1, 1, 1).requires_grad_()
    flow(u).square().sum().backward()
    assert (u.grad[1] == 0).all() and u.grad.isfinite().all() and (u.grad[0] != 0).any()


@pytest.mark.parametrize("shape, axis", [((5, 4), 0), ((4, 5), 1), ((4, 3, 3), 1)])
@pytest.mark.parametrize("of_field", [False, True])
def test_the_component_through_a_wall_gets_no_gradient(shape, axis, of_field):
    """It must be 0, so an optimiser must not move it."""
    d = len(shape)
    across = d - 1 - axis
    sizes = (1, d, *(n for a, n in enumerate(shape) if a != axis)) if of_field else (d,)
    velocity = torch.rand(sizes, dtype=torch.float64)
    velocity.select(1 if of_field else 0, across).zero_()
    velocity.requires_grad_()
    kinds = ["periodic"] * d
    kinds[axis] = "wall"
    flow = prdp.Flow(shape, 0.1, 0.01, boundary=kinds, wall_velocity={(axis, "high"): velocity}, solver=EXACT)
    u = flow.project(0.1 * random_velocity(shape))
    for states in (flow.rollout(u, 2), flow(u), flow.step_and_pressure(u)[1]):
        (bar,) = torch.autograd.grad(states.square().sum(), velocity)
        parts = bar.unbind(1 if of_field else 0)
        assert not parts[across].any()
        assert all(part.any() for c, part in enumerate(parts) if c != across) or states.shape[1] == 1
