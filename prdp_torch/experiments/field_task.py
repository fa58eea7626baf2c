"""The task "field": κ = exp(θ) is found from noisy snapshots of states that it diffuses, or from the pressures of a
Darcy flow."""

import math

import torch

from prdp_torch import operators
from prdp_torch.experiments import _C
from prdp_torch.experiments.checkpoint import load_optimiser, state_of
from prdp_torch.experiments.task import Task
from prdp_torch.implicit_step import ImplicitStep
from prdp_torch.solve import detach_failed


class Diffusion:
    """The operator of an implicit Euler step of u_t = ∇·(κ ∇u) on a periodic grid, for an `ImplicitStep`: assembled
    when κ changes, and the same for all steps of a rollout."""

    def __init__(self, dt, length):
        self.dt, self.length = dt, length
        self._assembled = None

    def take(self, kappa):
        self._assembled = operators.Stencil(*_C.diffusion_stencil(kappa, self.dt, self.length), "periodic")

    def __call__(self, u):
        return self._assembled

    def follow(self, scene, stepper, start):
        """All states of the initial states `start`."""
        return stepper.rollout(start, scene.field.steps)


class Darcy:
    """-∇·(κ ∇p) = f with p = 0 on the sides of a box, as a step for an `ImplicitStep`: from the pressures of the last
    κ, where the solve may start, to those of this one."""

    def __init__(self, length):
        self.length = length
        self.pressure = self._sources = self._assembled = None

    def take(self, kappa):
        self._assembled = operators.Diffusion(kappa[None], length=self.length)

    def __call__(self, pressure):
        return self._assembled

    def rhs(self, pressure):
        return self._sources

    def follow(self, scene, stepper, sources):
        """The pressures of the sources, with an axis as that of snapshots."""
        self._sources = sources
        pressure = stepper(torch.zeros_like(sources) if self.pressure is None else self.pressure)
        self.pressure = pressure.detach()
        return pressure.unsqueeze(1)


def make_stepper(scene, **options):
    """The step of the scene; its operator needs a κ before the first one."""
    if scene.physics.equation == "darcy":
        darcy = Darcy(scene.physics.length)
        return ImplicitStep(darcy, darcy.rhs, **options)
    return ImplicitStep(Diffusion(scene.physics.dt, scene.physics.length), **options)


def make_darcy_step(scene, **options):
    """From log κ, (batch, 1, *shape), to the pressures of -∇·(κ ∇p) = f: what an emulator is trained through."""

    def operator(log_kappa):
        return operators.Diffusion(log_kappa.squeeze(1).exp(), length=scene.physics.length)

    def sources(log_kappa):
        return torch.full_like(log_kappa, _C.DARCY_SOURCE)

    return ImplicitStep(operator, sources, **options)


def misfit(scene, stepper, problem, theta):
    """The mean over the states of (‖u - u_observed‖ / ‖u_observed‖)² over all snapshots."""
    equation = stepper.operator_at
    equation.take(theta.exp())
    states = equation.follow(scene, stepper, problem.start)
    if scene.on_failure == "zero_grad":
        states = detach_failed(states, stepper.info)
    return _C.normalised_mse(_C.observed(states, scene), problem.snapshots)


def make_task(scene, steppers, seed):
    """An interval is a single update, the metric the relative error of κ. A user knows the relative misfit alone."""
    (stepper,) = steppers
    problem = _C.make_field_problem(scene, seed)
    theta = problem.theta.clone().requires_grad_()
    optimiser = torch.optim.Adam([theta], lr=scene.learning_rate(0), fused=True)
    relative = 1.0  # before the first solve nothing is explained yet

    def updates(number):
        nonlocal relative
        for group in optimiser.param_groups:
            group["lr"] = scene.learning_rate(number)
        optimiser.zero_grad()
        squared = misfit(scene, stepper, problem, theta)
        loss = squared + scene.field.smoothing * _C.roughness(theta, scene.physics)
        loss.backward()
        optimiser.step()
        relative = math.sqrt(squared.detach())
        yield float(loss.detach()), None

    def metric():
        return float(_C.relative_error(theta.detach().exp(), problem.reference))

    equation = stepper.operator_at
    kept = scene.physics.equation == "darcy"

    def state():
        pressure = {"pressure": equation.pressure} if kept else {}
        return {"theta": theta.detach(), **pressure, **state_of(optimiser)}

    def load(saved, updates):
        theta.detach().copy_(saved.take("theta", theta))
        if kept:
            equation.pressure = saved.take("pressure", problem.start)
        load_optimiser(saved, optimiser, updates)

    return Task(updates, metric, lambda _: relative, state, load)
