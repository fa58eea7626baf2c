"""What `Flow` says about bad input, and about steps that fail."""

import copy
import pickle
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
    "misspelt boundary": ({"boundary": "walls"}, ValueError, "'periodic', 'wall' or 'open', got 'walls'"),
    "boundaries": (
        {"boundary": ("wall",) * 3},
        ValueError,
        "boundary must be one for all axes or one per axis, 2 here",
    ),
    "no name": ({"boundary": 3}, TypeError, "boundary must be a name or one per axis"),
    "length": ({"length": (1.0, 0.0)}, ValueError, "length must be finite and > 0, got 0"),
    "dt": ({"dt": 0.0}, ValueError, "dt must be finite and > 0, got 0"),
    "nu": ({"nu": -1.0}, ValueError, "nu must be finite and >= 0, got -1"),
    "nu of a shape": ({"nu": torch.ones(2)}, ValueError, "0-dimensional tensor, got shape [2]"),
    "advection": ({"advection": "weno"}, ValueError, "advection must be 'central' or 'upwind', got 'weno'"),
    "diffusion": ({"diffusion": "none"}, ValueError, "diffusion must be 'implicit' or 'explicit', got 'none'"),
    "mask of another shape": ({"obstacle": solid((7, 8))}, ValueError, "the shape of the grid, [8, 6], got [7, 8]"),
    "mask of numbers": ({"obstacle": torch.zeros(8, 6)}, TypeError, "obstacle must be a bool tensor"),
    "mask that fills": ({"obstacle": ~solid((8, 6))}, ValueError, "the obstacle fills the grid"),
    "force": ({"force": torch.zeros(3)}, ValueError, "force must have shape (2,) or (batch or 1, 2, 8, 6), got [3]"),
    "words as force": ({"force": "down"}, TypeError, "force must be a tensor or a tuple of numbers, got 'down'"),
    "inflow": ({"inflow": (1.0, 0.0)}, ValueError, "inflow is for an 'open' axis"),
    "no inflow": ({"boundary": ("wall", "open")}, ValueError, "an 'open' axis needs inflow"),
    "inflow of another shape": (
        {"boundary": ("wall", "open"), "inflow": torch.zeros(1, 2, 8, 6)},
        ValueError,
        "inflow must have shape (2,) or (batch or 1, 2, 8, 1), got [1, 2, 8, 6]",
    ),
    "two open axes": ({"boundary": "open", "inflow": (1.0, 0.0)}, ValueError, "at most one axis may be 'open'"),
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
        torch.linalg.LinAlgError, match=r"step 1 of 3: .*sample 2 NONFINITE_INPUT: .* at index \[1, 3, 4\]"
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
    words = r"1 of 2 samples failed: sample 1 NONFINITE_INPUT: inflow is not finite at index \[0, 3, 0\]"
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
    words = rf"Flow: {which} NONFINITE_INPUT: force is not finite at index \[{'1' if uniform else '0, 3, 2'}"
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


@pytest.mark.parametrize("change", ["set", "write", "data", "numpy", "load", "remove"])
def test_an_obstacle_may_move(change):
    """The box that the library keeps is that of the obstacle as it is now."""
    before, after = solid((8, 6), (3, 3)), solid((8, 6), (2, 1), (5, 4))
    flow = prdp.Flow((8, 6), 0.1, 0.01, obstacle=before.clone())
    u = 0.1 * random_velocity((8, 6))
    flow(u)
    if change == "set":
        flow.obstacle = after
    elif change == "write":
        flow.obstacle.copy_(after)
    elif change == "data":
        flow.obstacle.data = after
        flow.obstacle.data[5, 5] = True
        flow.obstacle.data[5, 5] = False
    elif change == "numpy":
        flow.obstacle.numpy()[:] = after.numpy()
    elif change == "load":
        flow.load_state_dict({"obstacle": after})
    else:
        flow.obstacle = None
    other = prdp.Flow((8, 6), 0.1, 0.01, obstacle=None if change == "remove" else after)
    assert torch.equal(flow(u), other(u)) and torch.equal(flow.divergence(u), other.divergence(u))


@pytest.mark.parametrize("rtol", [0.1, 1e-2, 1e-5])
@pytest.mark.parametrize("shape", [(16, 12), (4, 14, 11)])
def test_solid_faces_carry_no_velocity_and_solid_cells_no_pressure(shape, rtol):
    """Not even of the rounding of a preconditioner."""
    d, mask = len(shape), torch.zeros(shape, dtype=torch.bool)
    mask[..., 2:5, 1:3] = mask[..., 9:, 6:9] = True
    kinds = ["periodic", "wall", "open"][-d:]
    solver = prdp.CG(100, rtol=rtol, preconditioner="multigrid")
    flow = prdp.Flow(shape, 0.5, 0.02, boundary=kinds, obstacle=mask, inflow=(0.3,) * d, solver=solver)
    u, p = flow.step_and_pressure(0.1 * random_velocity(shape, batch=2, dtype=torch.float32))
    for axis in range(d):
        on_solid = mask | mask.roll(1, axis)
        if kinds[axis] == "wall":
            on_solid = on_solid | (torch.arange(shape[axis]) == 0).view(-1, *(1,) * (d - 1 - axis))
        elif kinds[axis] == "open":  # no cells before the first faces
            on_solid = torch.where(torch.arange(shape[axis]) == 0, mask, on_solid)
        assert (u[:, d - 1 - axis] * on_solid == 0).all()
    assert (p * mask == 0).all() and (p[..., -1] == 0).all()


def test_boundary_and_length_may_be_set():
    flow = prdp.Flow((8, 6), 0.1, 0.01)
    u = 0.1 * random_velocity((8, 6))
    periodic = flow(u)
    flow.boundary, flow.length = ["wall", "periodic"], 2.0
    other = prdp.Flow((8, 6), 0.1, 0.01, boundary=("wall", "periodic"), length=2.0)
    assert torch.equal(flow(u), other(u)) and not torch.equal(flow(u), periodic)
    flow.boundary[0] = "walls"
    with pytest.raises(ValueError, match="'periodic', 'wall' or 'open', got 'walls'"):
        flow(u)


def test_one_of_several_axes_is_no_value_for_all():
    for wrong in ({"length": (2.0,)}, {"boundary": ("wall",)}, {"boundary": ["wall"] * 3}):
        name = next(iter(wrong))
        with pytest.raises(ValueError, match=f"Flow: {name} must be one for all axes or one per axis, 2 here, got"):
            prdp.Flow((8, 6), 0.1, 0.01, **wrong)


@pytest.mark.parametrize("name, value, words", [
    ("dt", "a", "Flow: dt must be a real number, got 'a'"),
    ("force", 3.0, "Flow: force must be a torch tensor, got float"),
    ("length", torch.ones(2), "Flow: length must be a real number, got tensor"),
])  # fmt: skip
def test_what_is_set_wrongly_is_named_in_the_next_step(name, value, words):
    flow = prdp.Flow((8, 6), 0.1, 0.01)
    setattr(flow, name, value)
    with pytest.raises(TypeError, match=words):
        flow(torch.zeros(1, 2, 8, 6))


def test_an_obstacle_may_be_part_of_a_larger_tensor():
    masks = torch.stack([solid((7, 5), (3, 3)), solid((7, 5), (2, 1), (4, 4))])
    flow = prdp.Flow((7, 5), 0.1, 0.01, obstacle=masks[1])
    u = 0.1 * random_velocity((7, 5))
    assert torch.equal(flow(u), prdp.Flow((7, 5), 0.1, 0.01, obstacle=masks[1].clone())(u))
    masks.numpy()[1, 6, 4] = True
    assert torch.equal(flow(u), prdp.Flow((7, 5), 0.1, 0.01, obstacle=masks[1].clone())(u))


def test_an_obstacle_in_inference_mode_may_move():
    with torch.inference_mode():
        flow = prdp.Flow((8, 6), 0.1, 0.01, obstacle=solid((8, 6), (3, 3)))
        u = 0.1 * random_velocity((8, 6))
        flow(u)
        flow.obstacle[2, 1] = True
        assert torch.equal(flow(u), prdp.Flow((8, 6), 0.1, 0.01, obstacle=solid((8, 6), (3, 3), (2, 1)))(u))


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


def test_copies_pickles_and_parameters():
    nu, force = torch.nn.Parameter(torch.tensor(0.1)), torch.zeros(1, 2, 8, 6)
    flow = prdp.Flow((8, 6), nu, 0.01, force=force, obstacle=solid((8, 6), (3, 3)), inflow=None)
    assert [name for name, _ in flow.named_parameters()] == ["nu"]
    assert set(flow.state_dict()) == {"nu", "force", "obstacle"}
    u = random_velocity((8, 6))
    for other in (copy.deepcopy(flow), pickle.loads(pickle.dumps(flow))):
        assert torch.equal(other(0.1 * u), flow(0.1 * u))


GIVEN = {"nu": 0.1, "force": (0.8, 0.0), "inflow": (0.5, 0.0), "wall_velocity": {(0, "high"): 0.4}}
STATE = {"force", "inflow", "wall_velocity_0_high"}


def with_all(**changed):
    return prdp.Flow((8, 6), dt=0.01, boundary=("wall", "open"), **{**GIVEN, **changed})


@pytest.mark.parametrize("kept", ["nothing", "numbers", "parameters"])
def test_what_is_set_for_the_next_steps_is_no_state(kept):
    """Copies, averages and files have what was there before."""
    u = 0.1 * random_velocity((8, 6), batch=2)
    if kept == "nothing":
        flow = with_all(force=None, wall_velocity=None)
    elif kept == "numbers":
        flow = with_all()
    else:
        nu, force = (torch.nn.Parameter(torch.tensor(value)) for value in (0.1, (0.8, 0.0)))
        flow = with_all(nu=nu, force=force)
    before, state, names = flow(u), set(flow.state_dict()), [name for name, _ in flow.named_parameters()]
    assert state == {"nothing": {"inflow"}, "numbers": STATE, "parameters": STATE | {"nu"}}[kept]
    net = torch.nn.Linear(1, 2 * 8 * 6).double()
    made = net(torch.ones(2, 1).double()).view(2, 2, 8, 6)
    flow.force, flow.nu = made, made.square().mean()
    flow.inflow = made[..., :1]
    flow.wall_velocity = {(0, "high"): made[:, :, 0] * torch.tensor([1.0, 0.0])[:, None]}
    flow(u).square().sum().backward()
    assert net.weight.grad.abs().sum() > 0
    assert flow.force is made
    assert set(flow.state_dict()) == state and [name for name, _ in flow.named_parameters()] == names
    saved = pickle.loads(pickle.dumps(flow.state_dict()))
    others = copy.deepcopy(flow), copy.copy(flow), pickle.loads(pickle.dumps(flow))
    average = torch.optim.swa_utils.AveragedModel(flow)
    average.update_parameters(flow)
    for other in (*others, average.module):
        assert torch.equal(other(u), before)
        other.load_state_dict(saved)
        assert torch.equal(other(u), before)


def test_numbers_parameters_and_buffers_that_are_set_are_state():
    flow = with_all()
    flow.force = torch.ones(2, 2, 8, 6)
    flow.force = (0.1, 0.2)
    assert flow.state_dict()["force"].tolist() == [0.1, 0.2]
    flow.force = torch.nn.Parameter(torch.zeros(2))
    flow.nu = torch.tensor(0.3)
    flow.nu = 0.2
    flow.inflow = torch.nn.Buffer(torch.ones(2))
    assert [name for name, _ in flow.named_parameters()] == ["force"] and copy.deepcopy(flow).nu == 0.2
    flow.force = None
    assert set(flow.state_dict()) == STATE - {"force"} and not list(flow.parameters())


def test_controllers_set_the_tolerance():
    flow = prdp.Flow((16, 16), 0.1, 0.01)
    controller = prdp.ToleranceController([flow], ratio=0.1)
    controller.step(1.0)
    u = 0.1 * random_velocity((16, 16), dtype=torch.float32)
    flow(u)
    assert flow.info.residual.item() <= flow.rtol == 0.1
    few = flow.info.iterations.item()
    controller.step(1e-3)
    flow(u)
    assert flow.info.iterations.item() > few


def test_reports_combine_the_solves_of_a_step():
    flow = prdp.Flow((16, 12), 0.1, 0.01, boundary="wall", solver=prdp.CG(3, rtol=0.0))
    flow(0.1 * random_velocity((16, 12), batch=2))
    assert flow.info.iterations.tolist() == [12, 12]  # of two components, and of the pressure before and after
    assert statuses(flow.info) == ["MAX_ITER"] * 2
    assert not flow.converged
