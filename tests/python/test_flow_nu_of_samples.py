"""`Flow` with a nu for each sample, (batch,). Each sample has the result that it has alone."""

import contextlib
import functools

import pytest
import torch
from fibers import Fibers
from flows import by_other_ways
from test_gpu_flow import CASES, F32, F64, flow, noise

import prdp_torch as prdp

WAYS = {"loops": contextlib.nullcontext, "kernels": Fibers}
FACTORS = torch.tensor([0.3, 1.0, 40.0], dtype=F64)  # for the last, a share of the pressure is taken off (balance.cpp)
names = pytest.mark.parametrize("name", CASES)


def viscosities(name, dtype=F64):
    settings = CASES[name][1]
    factors = FACTORS.clamp_max(1.0) if settings.get("diffusion") == "explicit" else FACTORS
    return (settings["nu"] * factors).to(dtype)


def start(name, dtype=F64):
    shape = CASES[name][0]
    return 0.5 * noise(3, len(shape), *shape, seed=1, dtype=dtype)


def given(name, dtype, samples):
    """The tensors of a case for these of three samples."""
    of_three = {key: t[[0, 1, 0]] if t.dim() > 2 and t.size(0) == 2 else t for key, t in CASES[name][2].items()}
    return {key: (t[samples] if t.dim() > 2 and t.size(0) == 3 else t).to(dtype) for key, t in of_three.items()}


def outcome(name, samples, dtype=F64, graph=False, **options):
    """The states of two steps, the pressure of one, and the gradients of u and nu."""
    nu, u = (t[samples].clone().requires_grad_() for t in (viscosities(name, dtype), start(name, dtype)))
    step = flow(name, dtype, nu, given(name, dtype, samples), **options)
    found = step.rollout(u, 2), *step.step_and_pressure(u)
    weights = [noise(3, *t.shape[1:], seed=2, dtype=dtype)[samples] for t in found]
    grads = torch.autograd.grad(found, (u, nu), weights, create_graph=graph)
    return [t.detach() for t in (*found, *grads)]


ALL = [0, 1, 2]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
@names
def test_each_sample_is_as_alone(name, dtype, way):
    with WAYS[way]():
        together = outcome(name, ALL, dtype)
        alone = [outcome(name, [i], dtype) for i in ALL]
    for k, all_samples in enumerate(together):
        assert torch.equal(all_samples, torch.cat([one[k] for one in alone]))


@names
def test_it_is_the_flow_of_its_number(name):
    together = outcome(name, ALL)
    for i in ALL:
        nu, u = viscosities(name)[i].requires_grad_(), start(name)[[i]].requires_grad_()
        step = flow(name, F64, nu, given(name, F64, [i]))
        found = step.rollout(u, 2), *step.step_and_pressure(u)
        weights = [noise(3, *t.shape[1:], seed=2)[[i]] for t in found]
        grads = torch.autograd.grad(found, (u, nu), weights)
        for mine, other in zip(together, (*found, grads[0], grads[1][None]), strict=True):
            torch.testing.assert_close(mine[[i]], other, rtol=1e-10, atol=1e-11)


@names
def test_all_ways_agree(name):
    """Loops, kernels, the graph of second derivatives, and unrolled solves."""
    expected = outcome(name, ALL)
    for other in by_other_ways(functools.partial(outcome, name, ALL)):
        for mine, its in zip(other, expected, strict=True):
            torch.testing.assert_close(mine, its, rtol=1e-6, atol=1e-8)


@names
def test_gradients_against_finite_differences(name):
    u, weights = start(name), noise(3, *start(name).shape[1:], seed=2)

    def loss(nu):
        step = flow(name, F64, nu, given(name, F64, ALL))
        return (weights * step(step(u))).flatten(1).sum(1)

    nu = viscosities(name).requires_grad_()
    torch.autograd.gradcheck(loss, nu, atol=1e-6, rtol=1e-4, eps=1e-7)
    torch.autograd.gradgradcheck(loss, nu, atol=1e-4, rtol=1e-3, eps=1e-6)


def test_one_nu_of_shape_one_is_for_all_samples():
    u, one = start("cavity"), torch.tensor([0.3], dtype=F64, requires_grad=True)
    number = torch.tensor(0.3, dtype=F64, requires_grad=True)
    for way in WAYS.values():
        with way():
            both = [flow("cavity", F64, nu, given("cavity", F64, ALL)).rollout(u, 2) for nu in (one, number)]
            torch.testing.assert_close(*both, rtol=1e-12, atol=1e-13)
            grads = [torch.autograd.grad(t.square().sum(), nu)[0] for t, nu in zip(both, (one, number), strict=True)]
        assert grads[0].shape == (1,)
        torch.testing.assert_close(grads[0][0], grads[1], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("way", WAYS)
def test_no_viscosity_in_one_sample(way):
    """Of the others only a share of the pressure is taken off."""
    nu = torch.tensor([0.0, 5.0, 5.0], dtype=F64, requires_grad=True)
    with WAYS[way]():
        step = flow("viscous", F64, nu)
        for graph in (False, True):
            (found,) = torch.autograd.grad(step(start("viscous")).square().sum(), nu, create_graph=graph)
            assert found.isfinite().all() and (found != 0).all()


@pytest.mark.parametrize("way", WAYS)
def test_a_step_is_too_long_for_the_sample_that_has_no_viscosity_for_it(way):
    u = torch.zeros(2, 2, 8, 8, dtype=F64)
    u[:, 0] = 20.0  # dt |u|/dx = 1.6
    with WAYS[way]():
        step = prdp.Flow((8, 8), nu=torch.tensor([1e-3, 2.0], dtype=F64), dt=0.01, on_failure="return")
        after = step(u)
        assert step.info.status.tolist() == [prdp.SolveStatus.DIVERGED, prdp.SolveStatus.CONVERGED]
        assert (after[0] == 0).all() and torch.allclose(after[1], u[1])
        step.on_failure = "raise"
        with pytest.raises(torch.linalg.LinAlgError, match=r"sample 0 DIVERGED: .* is 1\.6, .* needs at most 1;"):
            step(u)


def test_a_network_sets_it_in_each_update():
    network = torch.nn.Sequential(torch.nn.Linear(4, 1), torch.nn.Softplus())
    step, u = prdp.Flow((8, 8), nu=1e-2, dt=0.01), 0.1 * noise(3, 2, 8, 8, dtype=F32)
    step.nu = network(noise(3, 4, dtype=F32))[:, 0]
    step.rollout(step.project(u), 3).square().sum().backward()
    assert all(p.grad.isfinite().all() and p.grad.any() for p in network.parameters())


def test_a_nu_that_is_true_is_one():
    u = start("periodic").requires_grad_()
    steps = [prdp.Flow(u.shape[2:], nu, 0.01) for nu in (torch.tensor([True]), 1.0)]
    grads = [torch.autograd.grad(step(u).square().sum(), u)[0] for step in steps]
    torch.testing.assert_close(*grads, rtol=1e-12, atol=1e-13)


def test_a_batch_without_samples():
    nu = torch.zeros(0, requires_grad=True)
    for step in (prdp.Flow((8, 8), nu, 0.01), prdp.Flow((8, 8), nu, 0.01, boundary="wall", diffusion="explicit")):
        states = step.rollout(torch.zeros(0, 2, 8, 8), 2)
        (grad,) = torch.autograd.grad(states.sum(), nu)
        assert states.shape == (0, 3, 2, 8, 8) and grad.shape == (0,)


def test_what_is_refused():
    with pytest.raises(TypeError, match="Flow: nu must be real, got complex64"):
        prdp.Flow((8, 8), nu=torch.tensor(1j), dt=0.01)
    u = torch.zeros(3, 2, 8, 8)
    with pytest.raises(ValueError, match=r"Flow: nu holds 2 samples, u holds 3"):
        prdp.Flow((8, 8), nu=torch.tensor([0.1, 0.2]), dt=0.01)(u)
    with pytest.raises(ValueError, match=r"Flow: nu must be a number, or a tensor of shape \(\) or \(batch or 1,\)"):
        prdp.Flow((8, 8), nu=torch.ones(3, 1), dt=0.01)
    for bad in (-1.0, torch.nan, torch.inf):
        with pytest.raises(ValueError, match=r"Flow: nu must be finite and >= 0, got \S+ at index 1"):
            prdp.Flow((8, 8), nu=torch.tensor([0.1, bad]), dt=0.01)
    with pytest.raises(ValueError, match=r"Flow: explicit diffusion needs nu dt Σ 2/dx² <= 1, got 2\.56"):
        prdp.Flow((8, 8), nu=torch.tensor([0.1, 1.0]), dt=0.01, diffusion="explicit")
