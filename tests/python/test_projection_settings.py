"""What of a `Flow` may be set, copied and moved: obstacles, boundaries, lengths, parameters and tolerances."""

import copy
import pickle

import pytest
import torch
from flows import random_velocity
from test_projection_errors import solid

import prdp_torch as prdp


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
    with pytest.raises(ValueError, match="'periodic', 'wall', 'slip' or 'open', got 'walls'"):
        flow(u)


@pytest.mark.parametrize("name, value, words", [
    ("dt", "a", "Flow: dt must be a real number, got 'a'"),
    ("force", 3.0, "Flow: force must be a torch tensor, got float"),
    ("length", torch.ones(2), "Flow: length must be a real number, got a tensor of shape"),
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


def test_the_form_of_the_pressure_is_not_set_over_the_method():
    flow = prdp.Flow((8, 8), nu=0.1, dt=0.01)
    with pytest.raises(AttributeError, match="pressure is a method; the form of the argument is set by pressure_form"):
        flow.pressure = "plain"


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


@pytest.mark.parametrize("boundary", ["periodic", "wall", ("open", "wall")])
@pytest.mark.parametrize("made_there", [False, True])
def test_a_flow_that_is_first_used_in_inference_mode_trains_later(boundary, made_there):
    """As Lightning validates before it trains."""
    u = 0.1 * random_velocity((8, 8))

    def flow(backward):
        force = (0.1, 0.2) if boundary == "wall" else None
        inflow = (0.0, 0.3) if boundary[0] == "open" else None
        return prdp.Flow((8, 8), 0.01, 0.01, boundary=boundary, force=force, inflow=inflow, backward=backward)

    for backward in ("implicit", "unrolled"):
        expected, found = [], []
        for results, mode in ((expected, torch.no_grad()), (found, torch.inference_mode())):
            step = flow(backward) if not made_there else None
            with mode:
                step = step or flow(backward)
                results.append(step(u).clone())
            x = u.clone().requires_grad_()
            results.append(torch.autograd.grad(step.project(x).square().sum(), x)[0])
            results.append(torch.autograd.grad(step(x).square().sum(), x, create_graph=True)[0])
            results.append(torch.autograd.grad(results[-1].square().sum(), x)[0])
        for mine, other in zip(found, expected, strict=True):
            assert torch.equal(mine, other)


def test_a_step_that_is_made_in_inference_mode_trains_later():
    with torch.inference_mode():
        step = prdp.Heat((8,), 0.1, 1.0, prdp.CG(100))
    u = torch.randn(2, 1, 8, dtype=torch.float64, requires_grad=True)
    expected = prdp.Heat((8,), 0.1, 1.0, prdp.CG(100))
    for made in (step, expected):
        made(u).square().sum().backward()
    assert torch.equal(step(u), expected(u))
