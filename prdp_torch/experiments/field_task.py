"""The task "field": a diffusivity κ = exp(θ) is found from noisy snapshots of states that it diffuses."""

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


def make_stepper(scene, **options):
    """The step of the scene; its operator needs a κ before the first one."""
    return ImplicitStep(Diffusion(scene.physics.dt, scene.physics.length), **options)


def misfit(scene, stepper, problem, theta):
    """The mean over the states of (‖u - u_observed‖ / ‖u_observed‖)² over all snapshots."""
    stepper.operator_at.take(theta.exp())
    states = stepper.rollout(problem.start, scene.field.steps)
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
        loss = squared + scene.field.smoothing * _C.roughness(theta, scene.physics.length)
        loss.backward()
        optimiser.step()
        relative = math.sqrt(squared.detach())
        yield float(loss.detach()), None

    def metric():
        return float(_C.relative_error(theta.detach().exp(), problem.reference))

    def state():
        return {"theta": theta.detach(), **state_of(optimiser)}

    def load(saved, updates):
        theta.detach().copy_(saved.take("theta", theta))
        load_optimiser(saved, optimiser, updates)

    return Task(updates, metric, lambda _: relative, state, load)
