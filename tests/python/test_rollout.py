"""Rollouts as one op: everything equals the chain of single steps."""

import pytest
import torch
from helpers import field, statuses
from torch.autograd import gradcheck, gradgradcheck
from torch.library import opcheck

import prdp_torch as prdp
from prdp_torch import fields

# name: (stepper, grid, channels, physics beside nu)
STEPPERS = {
    "poisson": (prdp.Poisson, (5,), 1, {}),
    "heat": (prdp.Heat, (3, 4), 1, {"dt": 1.0}),
    "burgers_1d": (prdp.Burgers, (9,), 1, {"dt": 0.1}),
    "burgers_2d": (prdp.Burgers, (3, 4), 2, {"dt": 0.1}),
    "navier_stokes": (prdp.NavierStokes, (3, 4), 3, {"dt": 0.1}),
}
steppers = pytest.mark.parametrize("name", STEPPERS)
modes = pytest.mark.parametrize("backward", ["implicit", "unrolled"])


def make(name, nu, solver, **options):
    stepper, shape, _, physics = STEPPERS[name]
    if name != "poisson":
        physics = {"nu": nu, **physics}
    # Navier-Stokes solves what is consistent of any cotangent, and its status tells.
    return stepper(shape, **physics, solver=solver, on_failure="return", **options)


def start(name, batch=2, dtype=torch.float64):
    _, shape, channels, _ = STEPPERS[name]
    u = field(shape, batch, dtype=dtype, channels=channels)
    return fields.project(u) if name == "navier_stokes" else u


def viscosity():
    return torch.tensor(2e-2, dtype=torch.float64, requires_grad=True)


def chain(stepper, u, steps):
    """The states and the reports of the steps, one call each."""
    states, infos = [u], []
    for _ in range(steps):
        states.append(stepper(states[-1]))
        infos.append(stepper.info)
    return torch.stack(states, 1), infos


def solver_for(name, exact):
    if exact:
        return prdp.Direct() if name == "navier_stokes" else prdp.GMRES(40, restart=8, rtol=1e-14)
    return prdp.GMRES(2, restart=3) if name == "navier_stokes" else prdp.Jacobi(4)


NONLINEAR = [name for name in STEPPERS if name not in ("poisson", "heat")]
same_as_chain = pytest.mark.parametrize("name, picard_steps", [(n, 1) for n in STEPPERS] + [(n, 2) for n in NONLINEAR])


@same_as_chain
@modes
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_gradients_and_reports_are_those_of_the_chain_to_the_last_bit(name, picard_steps, backward, dtype):
    options = {"picard_steps": picard_steps} if picard_steps > 1 else {}
    results = []
    for run in ("chain", "rollout"):
        nu, u = viscosity(), start(name, dtype=dtype).requires_grad_()
        stepper = make(name, nu, solver_for(name, exact=False), backward=backward, **options)
        if run == "chain":
            states, infos = chain(stepper, u, 3)
            report = [torch.stack([info[i] for info in infos], 1) for i in range(4)]
        else:
            states = stepper.rollout(u, 3)
            report = stepper.info[:4]
        weight = torch.randn(states.shape, generator=torch.Generator().manual_seed(5), dtype=dtype)
        inputs = (u,) if name == "poisson" else (u, nu)
        gradients = torch.autograd.grad((weight * states).sum(), inputs)
        results.append((states.detach(), *report, *gradients))
        if picard_steps == 1:  # the chain's last adjoint solve is that of the first step
            results[-1] += tuple(
                (part if run == "chain" else part[:, 0]).nan_to_num() for part in stepper.adjoint_info[:4]
            )
    for one, other in zip(*results, strict=True):
        assert one.dtype == other.dtype and torch.equal(one, other)
    assert all(bool(gradient.abs().max() > 0) for gradient in gradients)
    assert report[0].shape == (2, 3) and stepper.adjoint_info.status.shape == (2, 3 * picard_steps)


@steppers
@modes
def test_it_passes_gradcheck_and_gradgradcheck(name, backward):
    def run(u, nu):
        return make(name, nu, solver_for(name, exact=True), backward=backward).rollout(u, 2)

    inputs = start(name).requires_grad_(), viscosity()
    assert gradcheck(run, inputs)
    assert gradgradcheck(run, inputs, fast_mode=True)


@steppers
@modes
def test_second_derivatives_are_those_of_the_chain(name, backward):
    results = []
    for rolled in (False, True):
        u, nu = start(name).requires_grad_(), viscosity()
        stepper = make(name, nu, solver_for(name, exact=False), backward=backward)
        states = stepper.rollout(u, 2) if rolled else chain(stepper, u, 2)[0]
        (first,) = torch.autograd.grad((states**2).sum(), u, create_graph=True)
        results.append(torch.autograd.grad((first**2).sum(), u)[0])
        assert not rolled or stepper.adjoint_info.iterations.shape == (2, 2)
    torch.testing.assert_close(results[1], results[0], rtol=1e-12, atol=1e-12)


def test_a_loss_on_one_state_and_a_gradient_for_nu_alone():
    for t in range(4):
        gradients = []
        for rolled in (False, True):
            nu = viscosity()
            burgers = prdp.Burgers((9,), nu, 0.1, solver=prdp.Jacobi(4))
            u = field((9,))
            states = burgers.rollout(u, 3) if rolled else chain(burgers, u, 3)[0]
            gradients.append(torch.autograd.grad(states[:, t].sum(), nu, allow_unused=True)[0] if t else None)
        assert t == 0 or (torch.equal(*gradients) and gradients[0] != 0)


def test_it_is_one_node_that_keeps_only_what_the_derivative_needs():
    def kept(stepper, channels=1):
        u, sizes = field((20,), channels=channels).requires_grad_(), []
        with torch.autograd.graph.saved_tensors_hooks(lambda t: sizes.append(t.numel()) or t, lambda t: t):
            states = stepper.rollout(u, 5)
        assert "RolloutSolves" in states.grad_fn.name()
        assert {type(n[0]).__name__ for n in states.grad_fn.next_functions if n[0]} <= {"AccumulateGrad"}
        return max(sizes, default=0)

    states = 2 * 6 * 20
    jacobi = prdp.Jacobi(9)
    nu = torch.tensor(1e-3, requires_grad=True)
    assert kept(prdp.Heat((20,), 1e-3, 1.0, solver=jacobi)) <= 1  # nu
    assert kept(prdp.Poisson((20,), solver=jacobi)) <= 1
    assert kept(prdp.Heat((20,), nu, 1.0, solver=jacobi)) == states
    assert kept(prdp.Burgers((20,), 1e-3, 0.1, solver=jacobi)) == states
    assert kept(prdp.Heat((20,), 1e-3, 1.0, solver=jacobi, backward="unrolled")) == states


def test_none_gives_states_without_a_gradient():
    heat = prdp.Heat((9,), 1e-3, 1.0, solver=prdp.Jacobi(3), backward="none")
    u = field((9,)).requires_grad_()
    states = heat.rollout(u, 3)
    assert not states.requires_grad and torch.equal(states, chain(heat, u.detach(), 3)[0])


def test_no_steps_return_the_start():
    heat = prdp.Heat((9,), 1e-3, 1.0, solver=prdp.Jacobi(3))
    u = field((9,)).requires_grad_()
    states = heat.rollout(u, 0)
    assert torch.equal(states, u[:, None]) and heat.info.iterations.shape == (2, 0)
    assert torch.equal(torch.autograd.grad(states.sum(), u)[0], torch.ones_like(u))
    assert repr(heat.info) == "SolveInfo(; )"


def test_a_failure_says_in_which_step_and_which_sample():
    # Jacobi diverges on Poisson's matrix in two of three samples only where their state is not zero.
    u = field((5,), batch=3)
    u[1] = 1e300
    heat = prdp.Heat((5,), 1e-3, 1.0, solver=prdp.Jacobi(5))
    poisson = prdp.Poisson((5,), solver=prdp.CG(20))
    u[1] = 0
    u[1, 0, 2] = float("nan")
    with pytest.raises(torch.linalg.LinAlgError, match=r"step 1 of 4: linear_solve: 1 of 3 .*sample 1 NONFINITE_INPUT"):
        heat.rollout(u, 4)
    u[1] = 1e308  # Poisson's solution is smaller by 1/8 a step, heat's not larger: no failure
    assert statuses(SolveInfoOf(poisson, u))
    heat.rollout(field((5,)), 2)
