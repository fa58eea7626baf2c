"""Gradients of `Flow` against finite differences in float64."""

import contextlib

import pytest
import torch
from fibers import Fibers
from flows import random_velocity
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp

EXACT = prdp.CG(200, rtol=1e-13, preconditioner="multigrid")
CASES = {
    "periodic": {"shape": (5, 4)},
    "walls": {"shape": (4, 5), "boundary": "wall"},
    "open": {"shape": (4, 6), "boundary": ("wall", "open")},
    "obstacle": {"shape": (5, 7), "boundary": ("wall", "open"), "obstacle": [(2, 2), (2, 3), (3, 3)]},
    "holes": {"shape": (6, 6), "obstacle": [(1, 1), (3, 3), (3, 4), (2, 4), (4, 4), (3, 5)]},
    "3d": {"shape": (3, 3, 4), "boundary": ("periodic", "wall", "open"), "obstacle": [(1, 1, 1)]},
}


def make(name, nu, force, inflow, **options):
    case = dict(CASES[name])
    shape = case.pop("shape")
    if "obstacle" in case:
        solid = torch.zeros(shape, dtype=torch.bool)
        for cell in case["obstacle"]:
            solid[cell] = True
        case["obstacle"] = solid
    inflow = inflow if "open" in case.get("boundary", "") else None
    options = {"solver": EXACT, "adjoint_rtol": 1e-13, **options}
    return prdp.Flow(shape, nu, 0.02, force=force, inflow=inflow, **case, **options)


def inputs(name, batch=2):
    shape = CASES[name]["shape"]
    d = len(shape)
    generator = torch.Generator().manual_seed(1)
    inflow = 1 + 0.1 * torch.randn(batch, d, *shape[:-1], 1, generator=generator, dtype=torch.float64)
    force = torch.randn(1, d, *shape, generator=generator, dtype=torch.float64)
    nu = torch.tensor(0.3, dtype=torch.float64)
    return [t.requires_grad_() for t in (random_velocity(shape, batch), nu, force, inflow)]


def used(name, all_inputs):
    return all_inputs if "open" in CASES[name].get("boundary", "") else all_inputs[:3]


@pytest.mark.parametrize("advection", ["central", "upwind"])
@pytest.mark.parametrize("diffusion", ["implicit", "explicit"])
@pytest.mark.parametrize("name", CASES)
def test_loops_and_tensor_operations_make_the_same_step(name, diffusion, advection):
    u, nu, force, inflow = inputs(name, batch=3)
    nu = 0.05 * nu if diffusion == "explicit" else nu
    flow = make(name, nu, force, inflow, diffusion=diffusion, advection=advection)
    recorded = make(name, nu, force, inflow, diffusion=diffusion, advection=advection, backward="unrolled")
    strided = u.detach().transpose(-1, -2).contiguous().transpose(-1, -2)
    with torch.no_grad():
        by_loops = flow(strided)
    torch.testing.assert_close(by_loops, recorded(u).detach(), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("advection", ["central", "upwind"])
@pytest.mark.parametrize("diffusion", ["implicit", "explicit"])
@pytest.mark.parametrize("name", CASES)
def test_a_step_has_the_gradients_of_finite_differences(name, diffusion, advection):
    def step(u, nu, force, inflow=None):
        if diffusion == "explicit":
            nu = 0.05 * nu
        return make(name, nu, force, inflow, diffusion=diffusion, advection=advection)(u)

    assert gradcheck(step, used(name, inputs(name)))


@pytest.mark.parametrize("name", ["walls", "obstacle"])
def test_a_rollout_has_them_too(name):
    def states(u, nu, force, inflow=None):
        return make(name, nu, force, inflow).rollout(u, 3)

    assert gradcheck(states, used(name, inputs(name)))


@pytest.mark.parametrize("name", ["periodic", "obstacle"])
def test_project_and_pressure_have_them_too(name):
    def both(u, nu, force, inflow=None):
        flow = make(name, nu, force, inflow)
        return flow.project(u), flow.pressure(u), flow.divergence(u)

    assert gradcheck(both, used(name, inputs(name)))


@pytest.mark.parametrize("solver", [EXACT, prdp.Direct()], ids=repr)
@pytest.mark.parametrize("name", ["periodic", "walls", "3d"])
def test_project_has_the_same_gradient_at_rest(name, solver):
    """The map is affine. Nothing is solved where the divergence is zero, or less than a normal number."""
    u, *others = inputs(name)
    flow = make(name, *(t.detach()[:1] if t.dim() else t.detach() for t in others), solver=solver)
    weights = random_velocity(CASES[name]["shape"], 1, seed=3)
    at = torch.cat([0 * u[:1], u[:1], 1e-310 * u[:1]]).detach().requires_grad_()
    (found,) = torch.autograd.grad((flow.project(at) * weights).sum(), at, create_graph=True)
    torch.testing.assert_close(found[0], found[1], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found[2], found[1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("diffusion", ["implicit", "explicit"])
@pytest.mark.parametrize("name", CASES)
def test_a_step_and_its_pressure_at_once(name, diffusion):
    def both(u, nu, force, inflow=None):
        if diffusion == "explicit":
            nu = 0.05 * nu
        return make(name, nu, force, inflow, diffusion=diffusion).step_and_pressure(u)

    u, nu, force, inflow = inputs(name)
    flow = make(name, nu, force, inflow, diffusion=diffusion) if diffusion == "implicit" else None
    if flow is not None:
        found = flow.step_and_pressure(u)
        assert torch.equal(found[0], flow(u)) and torch.equal(found[1], flow.pressure(u))
        assert found[1].shape == (2, 1, *CASES[name]["shape"])
        grads = torch.autograd.grad(found[0].square().sum() + found[1].square().sum(), u)
        assert flow.adjoint_info.iterations.shape == (2,) and grads[0].isfinite().all()
    assert gradcheck(both, used(name, inputs(name)))


def test_second_derivatives_with_the_pressure():
    def both(u, nu, force):
        return make("walls", nu, force, None).step_and_pressure(u)

    assert gradgradcheck(both, inputs("walls", batch=1)[:3])


def test_unrolled_gradients_with_the_pressure():
    few = prdp.CG(2, rtol=0.0, preconditioner="diagonal")

    def both(u, nu, force):
        return make("walls", nu, force, None, solver=few, backward="unrolled", adjoint_rtol=None).step_and_pressure(u)

    assert gradcheck(both, inputs("walls", batch=1)[:3])


def test_a_failed_sample_has_a_state_and_a_pressure_of_zero_and_no_gradient():
    u, nu, force, _ = inputs("walls")
    flow = make("walls", nu, force, None, on_failure="zero_grad")
    broken = u.detach().clone()
    broken[1, 0, 2, 2] = torch.nan
    broken.requires_grad_()
    state, pressure = flow.step_and_pressure(broken)
    assert (state[1] == 0).all() and (pressure[1] == 0).all()
    torch.testing.assert_close(pressure[:1], flow.pressure(u)[:1])
    (found,) = torch.autograd.grad(state.square().sum() + pressure.square().sum(), broken)
    assert found.isfinite().all() and (found[1] == 0).all() and (found[0] != 0).any()


def test_second_derivatives():
    def states(u, nu, force):
        return make("walls", nu, force, None).rollout(u, 2)

    assert gradgradcheck(states, inputs("walls", batch=1)[:3])


def test_unrolled_gradients_are_those_of_the_iterations_that_ran():
    few = prdp.CG(2, rtol=0.0, preconditioner="diagonal")

    def step(u, nu, force):
        return make("walls", nu, force, None, solver=few, backward="unrolled", adjoint_rtol=None)(u)

    assert gradcheck(step, inputs("walls", batch=1)[:3])


def test_a_rollout_equals_its_steps_to_the_last_bit():
    u, nu, force, inflow = inputs("obstacle")
    flow = make("obstacle", nu, force, inflow)
    states = flow.rollout(u, 4)
    weights = random_velocity(CASES["obstacle"]["shape"], seed=3)
    found = torch.autograd.grad((states[:, -1] * weights).sum(), (u, nu, force, inflow))
    assert flow.info.iterations.shape == flow.adjoint_info.iterations.shape == (2, 4)
    v = u
    for k in range(4):
        v = flow(v)
        assert torch.equal(v, states[:, k + 1])
    expected = torch.autograd.grad((v * weights).sum(), (u, nu, force, inflow))
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-14)


def test_no_gradient_where_none_is_asked_for():
    u, nu, force, _ = inputs("periodic")
    assert not make("periodic", nu, force, None, backward="none")(u).requires_grad


def test_gradients_stay_finite_over_many_steps():
    flow = prdp.Flow((16, 16), 1e-3, 0.05, length=6.28, solver=prdp.CG(100, rtol=1e-6, preconditioner="multigrid"))
    u = flow.project(0.1 * random_velocity((16, 16), dtype=torch.float32)).requires_grad_()
    (flow.rollout(u, 1000)[:, -1] ** 2).sum().backward()
    assert u.grad.isfinite().all()
    assert flow.converged


@pytest.mark.parametrize("device", [contextlib.nullcontext, Fibers], ids=["loops", "kernels"])
def test_the_backward_pass_keeps_one_state_per_step(device):
    shape = (32, 32) if device is not Fibers else (6, 8)
    flow = prdp.Flow(shape, 0.1, 1e-3)
    u = flow.project(random_velocity(shape, dtype=torch.float32)).requires_grad_()
    kept = {}

    def pack(t):
        kept[t.untyped_storage().data_ptr()] = t.untyped_storage().nbytes()
        return t

    with device(), torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
        flow.rollout(u, 20)
    assert sum(kept.values()) < 22 * u.nbytes


@pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("solver", [
    prdp.CG(500, rtol=0.0), prdp.CG(5000, rtol=1e-20), prdp.CG(100, rtol=0.0, preconditioner="multigrid"),
    prdp.MINRES(400, rtol=0.0), prdp.BiCGStab(400, rtol=0.0), prdp.GMRES(10, restart=30, rtol=0.0),
], ids=str)  # fmt: skip
@pytest.mark.parametrize("boundary", ["periodic", "wall"])
def test_iterations_after_convergence_spoil_nothing(boundary, solver, dtype):
    """On square cells as on others: rounding would leave something in the null space of the pressure."""
    generator = torch.Generator().manual_seed(0)
    u, w = (torch.randn(2, 2, 16, 16, dtype=torch.float64, generator=generator) for _ in range(2))
    found = []
    for method, of in ((solver, dtype), (prdp.Direct(), torch.float64)):
        step = prdp.Flow((16, 16), nu=0.01, dt=0.005, boundary=boundary, solver=method)
        state = (0.1 * u).to(of).requires_grad_()
        after = step(state)
        found.append((after.detach().double(), torch.autograd.grad((w.to(of) * after).sum(), state)[0].double()))
    bound = 3e-6 if dtype == torch.float32 else 1e-12
    for got, expected in zip(*found, strict=True):
        assert (got - expected).norm() < bound * expected.norm()
