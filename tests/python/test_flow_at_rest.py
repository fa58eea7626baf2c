"""Flows with nothing to do: at rest, steady, decaying, without dependence on an axis. No step of them fails."""

import pytest
import torch
from flows import random_velocity
from hypothesis import given, settings
from hypothesis import strategies as st

import prdp_torch as prdp

F32, F64 = torch.float32, torch.float64


@pytest.mark.parametrize(
    "shape, nu, dt, dtype, steps",
    [
        ((16, 16), 1.0, 1e-2, F32, 250),
        ((8, 8, 8), 1.0, 0.1, F32, 150),
        ((12, 16), 1.0, 0.2, F64, 450),
    ],
)
def test_a_channel_reaches_its_steady_state_and_stays(shape, nu, dt, dtype, steps):
    """It does not depend on x, so that each projection takes the divergence further down. Between walls at the ends of
    [0, 1], the velocity is that of the steady equations with the same differences."""
    d = len(shape)
    force = (0.8 * nu, *[0.0] * (d - 1))
    flow = prdp.Flow(shape, nu=nu, dt=dt, boundary=("wall", *["periodic"] * (d - 1)), force=force)
    with torch.no_grad():
        u = flow.rollout(torch.zeros(1, d, *shape, dtype=dtype), steps)[:, -1]
    n = shape[0]
    second = 2 * torch.eye(n, dtype=F64) - torch.eye(n, dtype=F64).roll(1, 0) - torch.eye(n, dtype=F64).roll(-1, 0)
    second[0, -1] = second[-1, 0] = 0.0
    second[0, 0] = second[-1, -1] = 3.0  # half a cell from the wall
    steady = torch.linalg.solve(second * n**2, torch.full((n,), 0.8, dtype=F64))
    expected = steady.reshape(n, *[1] * (d - 1)).expand(shape)
    if nu * dt * steps > 2:
        torch.testing.assert_close(u[0, 0].double(), expected, rtol=1e-4, atol=1e-6)
    assert u[0, 1:].abs().max() <= 1e-15 * u.abs().max()


KINDS = ["periodic", "wall", "open"]
BOUNDARIES_2D = [(a, b) for a in KINDS for b in KINDS if (a, b) != ("open", "open")]
BOUNDARIES_3D = [
    (a, b, c) for a in KINDS for b in KINDS for c in KINDS if (a, b, c).count("open") < 2 and (b, c) != ("open", "wall")
]


def block(shape):
    solid = torch.zeros(shape, dtype=torch.bool)
    solid[tuple(slice(2, 4) for _ in shape)] = True
    return solid


def stream(shape, along):
    """A uniform velocity along a channel, which nothing changes on a periodic grid."""
    return torch.tensor([float(c == along) for c in range(len(shape))]).reshape(1, -1, *[1] * len(shape))


@settings(max_examples=20, deadline=None)
@given(
    boundary=st.sampled_from(BOUNDARIES_2D + BOUNDARIES_3D), single=st.booleans(), obstacle=st.booleans(),
    start=st.sampled_from(["rest", "noise", "least", "one axis"]), moves=st.booleans(), seed=st.integers(0, 10**6),
)  # fmt: skip
def test_no_step_of_a_flow_that_decays_fails(boundary, single, obstacle, start, moves, seed):
    """With so much viscosity a step takes decades off: it comes down to the least numbers within the rollout, and a
    gradient comes down to them on the way back."""
    dtype, d = (F32, F64)[not single], len(boundary)
    shape = (7, 6, 8)[-d:]
    inflow = (1e-2 * moves * stream(shape, d - 1 - boundary.index("open"))).flatten() if "open" in boundary else None
    solid = block(shape) if obstacle else None
    flow = prdp.Flow(shape, nu=1.0, dt=1.0, boundary=boundary, obstacle=solid, inflow=inflow)
    u = 1e-2 * random_velocity(shape, seed=seed, dtype=dtype)
    if start == "rest":
        u = torch.zeros_like(u)
    elif start == "least":
        u = u * torch.finfo(dtype).tiny
    elif start == "one axis":
        u = u.select(-1, 0).unsqueeze(-1).expand_as(u).contiguous()
    if moves and set(boundary) == {"periodic"} and not obstacle:
        u = u + 1e-2 * stream(shape, seed % d).to(dtype)
    u.requires_grad_()
    steps = 40 if single else 100
    states = flow.rollout(flow.project(u), steps)
    assert states.isfinite().all()
    (g,) = torch.autograd.grad(states[:, -1].sum() + states[:, steps // 2].square().sum(), u)
    assert g.isfinite().all()


@pytest.mark.parametrize("boundary", BOUNDARIES_2D)
def test_hundreds_of_steps_from_all_but_rest(boundary):
    inflow = (0.0, 0.0) if "open" in boundary else None
    flow = prdp.Flow((6, 5), nu=0.1, dt=0.1, boundary=boundary, inflow=inflow)
    u = 1e-30 * random_velocity((6, 5), dtype=F32)
    with torch.no_grad():
        u = flow.rollout(u, 300)[:, -1]
    assert u.isfinite().all() and u.abs().max() < 1e-29


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("scale", [-126.0, -140.0, -149.0])
def test_projections_of_the_least_numbers_fail_neither_forwards_nor_backwards(scale, dtype):
    for shape, boundary in (((9, 8), ("wall", "periodic")), ((9, 8), "wall"), ((5, 6, 4), "periodic")):
        flow = prdp.Flow(shape, 0.1, 1e-3, boundary=boundary)
        least = 2.0 ** (scale if dtype == F32 else scale - 925)
        u = (least * random_velocity(shape, dtype=F64)).to(dtype).requires_grad_()
        projected = flow.project(u)
        (g,) = torch.autograd.grad(projected, u, (least * random_velocity(shape, seed=1, dtype=F64)).to(dtype))
        assert projected.isfinite().all() and g.isfinite().all()
        assert projected.abs().max() <= 2 * u.abs().max() and g.abs().max() <= 8 * least
