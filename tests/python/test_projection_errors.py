"""What `Flow` says about bad input, and about steps that fail."""

import re

import pytest
import torch
from flows import random_velocity
from helpers import statuses

import prdp_torch as prdp


def solid(shape, *cells):
    mask = torch.zeros(shape, dtype=torch.bool)
    for cell in cells:
        mask[cell] = True
    return mask


BAD = {
    "one axis": ({"shape": (8,)}, ValueError, "shape must have 2 or 3 extents"),
    "few cells": ({"shape": (8, 2)}, ValueError, "every extent of shape must be >= 3, got [8, 2]"),
    "misspelt boundary": ({"boundary": "walls"}, ValueError, "'periodic', 'wall', 'slip' or 'open', got 'walls'"),
    "boundaries": (
        {"boundary": ("wall",) * 3},
        ValueError,
        "boundary must be one for all axes or one per axis, 2 here",
    ),
    "no name": ({"boundary": 3}, TypeError, 'boundary must be "periodic", "wall", "slip" or "open", or one'),
    "length": ({"length": (1.0, 0.0)}, ValueError, "length must be finite and > 0, got 0"),
    "dt": ({"dt": 0.0}, ValueError, "dt must be finite and > 0, got 0"),
    "nu": ({"nu": -1.0}, ValueError, "nu must be finite and >= 0, got -1"),
    "nu of a shape": ({"nu": torch.ones(2, 1)}, ValueError, "of shape () or (batch or 1,), got [2, 1]"),
    "advection": ({"advection": "weno"}, ValueError, "advection must be 'central' or 'upwind', got 'weno'"),
    "diffusion": ({"diffusion": "none"}, ValueError, "diffusion must be 'implicit' or 'explicit', got 'none'"),
    "mask of another shape": (
        {"obstacle": solid((7, 8))},
        ValueError,
        "the shape of the grid, [8, 6], or (batch or 1) of them, got [7, 8]",
    ),
    "mask of numbers": ({"obstacle": torch.zeros(8, 6)}, TypeError, "obstacle must be a bool tensor"),
    "mask that fills": ({"obstacle": ~solid((8, 6))}, ValueError, "the obstacle fills the grid"),
    "force": ({"force": torch.zeros(3)}, ValueError, "force must have shape (2,) or (batch or 1, 2, 8, 6), got [3]"),
    "words as force": ({"force": "down"}, TypeError, "force must be a tensor or a tuple of numbers, got 'down'"),
    "inflow": ({"inflow": (1.0, 0.0)}, ValueError, "inflow is for an open axis"),
    "no inflow": ({"boundary": ("wall", "open")}, ValueError, "an open axis needs inflow"),
    "inflow of another shape": (
        {"boundary": ("wall", "open"), "inflow": torch.zeros(1, 2, 8, 6)},
        ValueError,
        "inflow must have shape (2,) or (batch or 1, 2, 8, 1), got [1, 2, 8, 6]",
    ),
    "two open axes": ({"boundary": "open", "inflow": (1.0, 0.0)}, ValueError, "at most one axis may be open"),
    "inflow that cannot leave": (
        {"boundary": ("wall", "open"), "inflow": (1.0, 0.0), "obstacle": solid((8, 6), (slice(None), 3))},
        ValueError,
        "keeps fluid that comes in at the open end from going out",
    ),
    "explicit diffusion": (
        {"nu": 1.0, "dt": 0.1, "diffusion": "explicit"},
        ValueError,
        "explicit diffusion needs nu dt Σ 2/dx² <= 1, got 20",
    ),
    "start": ({"start": "state"}, ValueError, "start must be 'zero'"),
    "solver": ({"solver": 3}, TypeError, "solver must be a Solver"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments_are_named_before_any_work(name):
    wrong, kind, message = BAD[name]
    with pytest.raises(kind, match=re.escape(message)):
        prdp.Flow(**{"shape": (8, 6), "nu": 0.1, "dt": 0.01, **wrong})


@pytest.mark.parametrize(
    "u, kind, message",
    [
        (torch.zeros(1, 3, 8, 6), ValueError, "expected u of shape (batch, 2, 8, 6), got [1, 3, 8, 6]"),
        (torch.zeros(2, 8, 6), ValueError, "expected u of shape (batch, 2, 8, 6), got [2, 8, 6]"),
        (torch.zeros(1, 2, 8, 6, dtype=torch.int64), TypeError, "u must be float32 or float64"),
        ([[0.0]], TypeError, "u must be a torch tensor"),
    ],
)
@pytest.mark.parametrize("call", ["forward", "project", "pressure", "divergence", "rollout"])
def test_states_that_do_not_fit_are_named(u, kind, message, call):
    flow = prdp.Flow((8, 6), 0.1, 0.01)
    arguments = (u, 2) if call == "rollout" else (u,)
    with pytest.raises(kind, match=re.escape(message)):
        getattr(flow, call)(*arguments)


def test_a_force_for_another_batch_is_named():
    flow = prdp.Flow((8, 6), 0.1, 0.01, force=torch.zeros(3, 2, 8, 6))
    with pytest.raises(ValueError, match="force holds 3 samples, u holds 2"):
        flow(torch.zeros(2, 2, 8, 6))


def too_fast():
    u = torch.zeros(3, 2, 8, 6, dtype=torch.float64)
    u[0] = random_velocity((8, 6))[0] * 0.01
    u[1, 0] = 30.0  # 1.8 cells per step
    u[2, 1, 3, 4] = float("nan")
    return u


def test_a_step_that_is_too_long_is_an_error_and_never_nan():
    flow = prdp.Flow((8, 6), 0.01, 0.01)
    with pytest.raises(torch.linalg.LinAlgError, match=r"sample 1 DIVERGED: dt Σ \|u\|/dx is 1.8, and .* at most 1"):
        flow(too_fast())
    with pytest.raises(
        torch.linalg.LinAlgError, match=r"step 1 of 3: .*sample 2 NONFINITE_INPUT: .* at index \(1, 3, 4\)"
    ):
        flow.rollout(too_fast(), 3)


@pytest.mark.parametrize("on_failure", ["return", "zero_grad"])
def test_the_other_samples_go_on(on_failure):
    flow = prdp.Flow((8, 6), 0.01, 0.01, on_failure=on_failure)
    u = too_fast().requires_grad_()
    states = flow.rollout(u, 2)
    assert flow.info.status[:, 0].tolist() == [1, prdp.SolveStatus.DIVERGED, prdp.SolveStatus.NONFINITE_INPUT]
    assert states[:, 1:].isfinite().all()
    (states[:, -1] ** 2).sum().backward()
    assert (u.grad[1:] == 0).all()
    alone = too_fast()[:1].requires_grad_()
    (flow.rollout(alone, 2)[:, -1] ** 2).sum().backward()
    assert torch.equal(u.grad[:1], alone.grad)


def test_an_instability_ends_in_an_error():
    """Central differences without viscosity grow from step to step."""
    flow = prdp.Flow((16, 16), 0.0, 0.05)
    u = flow.project(random_velocity((16, 16), dtype=torch.float32)) * 0.2
    with pytest.raises(
        torch.linalg.LinAlgError, match=r"step \d+ of 2000: Flow: 1 of 1 samples failed: sample 0 DIVERGED"
    ):
        flow.rollout(u, 2000)


def test_an_inflow_that_is_not_finite_is_named():
    inflow = torch.ones(2, 2, 8, 1)
    inflow[1, 0, 3, 0] = torch.nan
    flow = prdp.Flow((8, 6), 0.1, 0.01, boundary=("wall", "open"), inflow=inflow)
    words = r"1 of 2 samples failed: sample 1 NONFINITE_INPUT: inflow is not finite at index \(0, 3, 0\)"
    with pytest.raises(torch.linalg.LinAlgError, match=words):
        flow(torch.zeros(2, 2, 8, 6))


@pytest.mark.parametrize("uniform", [True, False])
@pytest.mark.parametrize("on_failure", ["raise", "warn", "return", "zero_grad"])
def test_a_force_that_is_not_finite_is_named_and_leaves_other_samples_alone(uniform, on_failure):
    force = torch.ones(2) if uniform else torch.ones(2, 2, 8, 6)
    force[(1,) if uniform else (1, 0, 3, 2)] = torch.inf
    flow = prdp.Flow((8, 6), 0.1, 0.01, force=force, on_failure=on_failure)
    u = (0.1 * random_velocity((8, 6), dtype=torch.float32)[:1]).repeat(2, 1, 1, 1).requires_grad_()
    which = r"2 of 2 samples failed: sample 0" if uniform else "1 of 2 samples failed: sample 1"
    words = rf"Flow: {which} NONFINITE_INPUT: force is not finite at index \({'1' if uniform else '0, 3, 2'}"
    if on_failure == "raise":
        with pytest.raises(torch.linalg.LinAlgError, match=words):
            flow(u)
        return
    if on_failure == "warn":
        with pytest.warns(UserWarning, match=words) as caught:
            states = flow(u)
        assert len(caught) == 1
    else:
        states = flow(u)
    failed = ["NONFINITE_INPUT"] * 2 if uniform else [statuses(flow.info)[0], "NONFINITE_INPUT"]
    assert statuses(flow.info) == failed and (states[1] == 0).all()
    if uniform:
        return
    alone = prdp.Flow((8, 6), 0.1, 0.01, force=force[:1])
    v = u.detach()[:1].requires_grad_()
    assert torch.equal(states[:1], alone(v))
    states.square().sum().backward()
    alone(v).square().sum().backward()
    assert torch.equal(u.grad[:1], v.grad) and (u.grad[1] == 0).all()


def test_one_of_several_axes_is_no_value_for_all():
    for wrong in ({"length": (2.0,)}, {"boundary": ("wall",)}, {"boundary": ["wall"] * 3}):
        name = next(iter(wrong))
        with pytest.raises(ValueError, match=f"Flow: {name} must be one for all axes or one per axis, 2 here, got"):
            prdp.Flow((8, 6), 0.1, 0.01, **wrong)


def test_a_start_is_refused():
    with pytest.raises(ValueError, match="Flow: start must be 'zero': its solves are for changes, got 'state'"):
        prdp.Flow((8, 6), 0.1, 0.01).start = "state"


@pytest.mark.filterwarnings("ignore:`torch.jit.script")  # by torch's own forward mode
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_transforms_and_forward_mode_are_refused(backward):
    """They would compute something else."""
    u = 0.1 * random_velocity((8, 6))
    flow = prdp.Flow((8, 6), 0.1, 0.01, backward=backward)
    for transform in (torch.func.grad, torch.func.jacfwd, torch.func.jacrev):
        with pytest.raises(NotImplementedError, match=r"Flow: takes no transform of torch.func"):
            transform(lambda v: flow(v).square().sum())(u)
    with pytest.raises(NotImplementedError, match=r"Flow: takes no transform of torch.func"):
        torch.func.jvp(lambda v: flow.rollout(v, 2), (u,), (u,))
    with pytest.raises(NotImplementedError, match=r"Flow: takes no transform of torch.func"):
        torch.func.vmap(flow)(u[None])
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual
        with pytest.raises(NotImplementedError, match="Flow: takes no dual tensors of forward mode"):
            flow(dual(u, u))
        of_nu = prdp.Flow((8, 6), torch.tensor(0.1, dtype=u.dtype), 0.01, backward=backward)
        of_nu.nu = dual(of_nu.nu, torch.ones_like(of_nu.nu))
        for call in (of_nu, of_nu.pressure, of_nu.step_and_pressure):
            with pytest.raises(NotImplementedError, match="Flow: takes no dual tensors of forward mode"):
                call(u)


def test_reports_combine_the_solves_of_a_step():
    flow = prdp.Flow((16, 12), 0.1, 0.01, boundary="wall", solver=prdp.CG(3, rtol=0.0))
    flow(0.1 * random_velocity((16, 12), batch=2))
    assert flow.info.iterations.tolist() == [12, 12]  # of two components, and of the pressure before and after
    assert statuses(flow.info) == ["MAX_ITER"] * 2
    assert not flow.converged
