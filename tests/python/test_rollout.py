"""Rollouts as one op: everything equals the chain of single steps."""

import contextlib
import re

import pytest
import torch
from fibers import Fibers
from helpers import field, modes, statuses
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp
from prdp_torch import fields, operators

# name: (stepper, grid, channels, physics beside nu)
STEPPERS = {
    "poisson": (prdp.Poisson, (5,), 1, {}),
    "heat": (prdp.Heat, (3, 4), 1, {"dt": 1.0}),
    "burgers_1d": (prdp.Burgers, (9,), 1, {"dt": 0.1}),
    "burgers_2d": (prdp.Burgers, (3, 4), 2, {"dt": 0.1}),
    "navier_stokes": (prdp.NavierStokes, (3, 4), 3, {"dt": 0.1}),
}
steppers = pytest.mark.parametrize("name", STEPPERS)


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


@pytest.mark.parametrize("name", NONLINEAR)
@pytest.mark.parametrize("rolled", [False, True])
def test_recorded_gradients_of_unrolled_flows_are_the_plain_ones(name, rolled):
    """b and the winds of a step are one tensor, and depend on nu by the steps before."""
    results = []
    for create_graph in (False, True):
        u, nu = start(name).requires_grad_(), viscosity()
        stepper = make(name, nu, solver_for(name, exact=False), backward="unrolled", picard_steps=2)
        states = stepper.rollout(u, 3) if rolled else chain(stepper, u, 3)[0]
        results.append(torch.autograd.grad((states**2).sum(), (u, nu), create_graph=create_graph))
    for plain, recorded in zip(*results, strict=True):
        torch.testing.assert_close(recorded, plain, rtol=1e-10, atol=1e-12)


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


@pytest.mark.parametrize("device", [contextlib.nullcontext, Fibers], ids=["loops", "kernels"])
def test_it_is_one_node_that_keeps_only_what_the_derivative_needs(device):
    def kept(stepper, channels=1):
        u, sizes = field((20,), channels=channels).requires_grad_(), []
        with device(), torch.autograd.graph.saved_tensors_hooks(lambda t: sizes.append(t.numel()) or t, lambda t: t):
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


def test_no_steps_return_the_start():
    heat = prdp.Heat((9,), 1e-3, 1.0, solver=prdp.Jacobi(3))
    u = field((9,)).requires_grad_()
    states = heat.rollout(u, 0)
    assert torch.equal(states, u[:, None]) and heat.info.iterations.shape == (2, 0)
    assert torch.equal(torch.autograd.grad(states.sum(), u)[0], torch.ones_like(u))
    assert repr(heat.info) == "SolveInfo(; )"


def test_a_failure_says_in_which_step_and_which_sample():
    def growing(on_failure):  # by 1e7 a step, until a sample leaves the range of float32
        return prdp.Poisson((4,), prdp.Direct(), length=1e4, on_failure=on_failure)

    u, steps = field((4,), batch=8, dtype=torch.float32) * 10.0 ** torch.arange(0, 16, 2).view(8, 1, 1), 4
    failed = torch.stack([info.status < -2 for info in chain(growing("return"), u, steps)[1]])
    step, sample = failed.nonzero()[0].tolist()
    assert step > 0 and not failed[step].all()
    what = rf"step {step + 1} of {steps}: linear_solve: {int(failed[step].sum())} of 8 samples failed: sample {sample} "
    with pytest.raises(torch.linalg.LinAlgError, match=what):
        growing("raise").rollout(u, steps)
    with pytest.warns(UserWarning) as caught:
        growing("warn").rollout(u, steps)
    assert re.match(what, str(caught[0].message))
    heat = prdp.Heat((5,), 1e-3, 1.0, solver=prdp.Jacobi(3))
    with pytest.raises(torch.linalg.LinAlgError, match=r"^linear_solve: 1 of 2 samples"):  # a lone step has no number
        heat(torch.full((2, 1, 5), float("nan")).index_fill(0, torch.tensor([0]), 1.0))


@steppers
def test_a_failed_adjoint_solve_says_it_too(name):
    stepper = make(name, viscosity(), solver_for(name, exact=False))
    stepper.on_failure = "raise"
    for create_graph in (False, True):
        states = stepper.rollout(start(name, batch=3).requires_grad_(), 4)
        cotangent = torch.zeros_like(states)
        cotangent[1, 3] = float("nan")
        with pytest.raises(
            torch.linalg.LinAlgError,
            match="step 3 of 4: adjoint solve: 1 of 3 samples failed: sample 1 NONFINITE_INPUT",
        ):
            states.backward(cotangent, create_graph=create_graph)


def test_refused_samples_carry_no_gradient():
    nu, u = viscosity(), field((9,), batch=3)
    u[1, 0, 2] = float("nan")
    u.requires_grad_()
    results = []
    for rolled in (False, True):
        burgers = prdp.Burgers((9,), nu, 0.1, solver=prdp.Jacobi(4), on_failure="return")
        states = burgers.rollout(u, 3) if rolled else chain(burgers, u, 3)[0]
        results.append(torch.autograd.grad(states[:, 1:].sum(), (u, nu)))
    assert statuses(burgers.info._replace(status=burgers.info.status[:, 0]))[1] == "NONFINITE_INPUT"
    assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][1], results[1][1])
    assert results[0][0].isfinite().all()


def test_fields_rollout_takes_it_unless_forward_is_the_users():
    class Forced(prdp.Heat):
        def forward(self, u):
            return super().forward(u) + 1.0

    u = field((9,)).requires_grad_()
    heat, forced = (cls((9,), 1e-3, 1.0, solver=prdp.Jacobi(3)) for cls in (prdp.Heat, Forced))
    assert "RolloutSolves" in fields.rollout(heat, u, 2).grad_fn.name()
    assert torch.equal(fields.rollout(forced, u, 2), torch.stack([u, forced(u), forced(forced(u))], 1))


def halved(step, how):
    """The step and half of what it makes: by a subclass, a hook, or a forward of its own."""
    if how == "subclass":
        step.__class__ = type(
            "Half", (type(step),), {"forward": lambda self, u: 0.5 * type(step).__mro__[1].forward(self, u)}
        )
    elif how == "hook":
        step.register_forward_hook(lambda module, given, found: 0.5 * found)
    else:
        forward = step.forward
        step.forward = lambda u: 0.5 * forward(u)
    return step


@pytest.mark.parametrize("how", ["subclass", "hook", "attribute"])
@pytest.mark.parametrize("step", ["heat", "own", "flow"])
def test_a_rollout_equals_calls_where_they_do_more_than_the_step(step, how):
    u = field((8,)) if step != "flow" else 0.1 * fields.project(field((8, 8), channels=2))
    solver = prdp.CG(20)
    half = halved(
        prdp.Heat((8,), 1e-2, 1.0, solver)
        if step == "heat"
        else prdp.ImplicitStep(operators.Heat((8,), 1e-2, 1.0), solver=solver)
        if step == "own"
        else prdp.Flow((8, 8), nu=1e-3, dt=1e-2),
        how,
    )
    ends = half(half(v := u.clone().requires_grad_()))
    ends.sum().backward()
    for rollout in (half.rollout, lambda u, steps: fields.rollout(half, u, steps)):
        states = rollout(w := u.clone().requires_grad_(), 2)
        states[:, -1].sum().backward()
        assert torch.equal(states[:, -1], ends) and torch.equal(v.grad, w.grad)
        assert half.info.status.shape == half.adjoint_info.status.shape == (2, 2)
    half(w).sum().backward()
    assert half.adjoint_info.status.shape == (2,)


def test_a_forward_that_calls_the_rollout_that_calls_it_is_named():
    class Coarse(prdp.Heat):
        def forward(self, u):
            return self.rollout(u, 2)[:, -1]

    coarse = Coarse((8,), 1e-2, 1.0, prdp.CG(20))
    with pytest.raises(RuntimeError, match=r"Coarse\.rollout: it repeats .* the forward call the rollout of a step"):
        coarse(field((8,)))


@pytest.mark.parametrize("flow", [False, True])
def test_the_first_state_keeps_its_gradient_where_steps_have_none(flow):
    heat = prdp.Heat((8,), 1e-2, 1.0, prdp.CG(20), backward="none")
    step = prdp.Flow((8, 8), nu=1e-3, dt=1e-2, backward="none") if flow else heat
    u = (0.1 * fields.project(field((8, 8), channels=2)) if flow else field((8,))).requires_grad_()
    states = step.rollout(u, 2)
    assert torch.equal(states, torch.stack([u, step(u), step(step(u))], 1))
    (found,) = torch.autograd.grad((states**2).sum(), u)
    assert torch.equal(found, 2 * u)


@pytest.mark.parametrize(
    "call, error, message",
    [
        (lambda heat, u: heat.rollout(u, -1), ValueError, "rollout: steps must be >= 0, got -1"),
        (lambda heat, u: heat.rollout(u, 1.5), TypeError, "rollout: steps must be a whole number, got 1.5"),
        (lambda heat, u: heat.rollout(u[0], 2), ValueError, r"Heat: expected \(batch, 1, 9\), got \(1, 9\)"),
        (lambda heat, u: heat.rollout(None, 2), TypeError, "Heat: u must be a torch tensor, got NoneType"),
    ],
)
def test_bad_arguments_are_refused_in_words(call, error, message):
    with pytest.raises(error, match=message):
        call(prdp.Heat((9,), 1e-3, 1.0, solver=prdp.Jacobi(3)), field((9,)))


def most_fields(call, numbers):
    """The most memory of torch that is held meanwhile, in fields of so many numbers in float32."""
    with torch.profiler.profile(profile_memory=True) as profile:
        call()
    held = most = 0
    for event in profile.profiler.kineto_results.events():
        if event.name() == "[memory]":
            held += event.nbytes()
            most = max(most, held)
    return most / (4 * numbers)


HELD = {  # with the fields of a step at work, forward and back
    "heat": (lambda: prdp.Heat((24, 24), 1e-3, 1.0, solver=prdp.CG(4)), 1, 3, 5),
    "flow": (lambda: prdp.Flow((24, 24), nu=1e-3, dt=1e-2, solver=prdp.CG(4), on_failure="return"), 2, 9, 10),
}


@pytest.mark.parametrize("way", ["loops", "kernels"])
@pytest.mark.parametrize("name", HELD)
def test_a_rollout_holds_its_states_once(name, way):
    """And no more for a longer one, forward and back."""
    make, channels, forward, back = HELD[name]
    step, steps = make(), 20
    state = (0.1 * torch.randn(1, channels, 24, 24)).requires_grad_()
    with Fibers(poison=False) if way == "kernels" else contextlib.nullcontext():
        step.rollout(state, 1).sum().backward()
        made = []
        states_and_work = most_fields(lambda: made.append(step.rollout(state, steps)), state.numel())
        assert steps + 1 <= states_and_work < steps + 1 + forward
        cotangent = torch.ones(()).expand(made[0].shape)
        assert most_fields(lambda: made[0].backward(cotangent), state.numel()) < back
