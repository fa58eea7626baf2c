"""The task "field": a diffusivity κ = exp(θ) is found from noisy snapshots of states that it diffuses."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from prdp_torch import operators
from prdp_torch.experiments import _C
from prdp_torch.experiments.checkpoint import load_optimiser, state_of
from prdp_torch.experiments.task import Task
from prdp_torch.implicit_step import ImplicitStep
from prdp_torch.solve import detach_failed
from prdp_torch.stepper import Stepper


class Diffusion:
    """The operator of an implicit Euler step of u_t = ∇·(κ ∇u) on a periodic grid, for an `ImplicitStep`: assembled
    when κ changes, and the same for all steps of a rollout."""

    def __init__(self, dt: float, length: Sequence[float]) -> None:
        self.dt, self.length = dt, length
        self._assembled: operators.Stencil | None = None

    def take(self, kappa: Tensor) -> None:
        self._assembled = operators.Stencil(*_C.diffusion_stencil(kappa, self.dt, self.length), "periodic")

    def __call__(self, u: Tensor) -> operators.Stencil:
        assert self._assembled is not None
        return self._assembled


def make_stepper(scene: _C.Scene, **options: Any) -> ImplicitStep:
    """The step of the scene; its operator needs a κ before the first one."""
    return ImplicitStep(Diffusion(scene.physics.dt, scene.physics.length), **options)


def misfit(scene: _C.Scene, stepper: ImplicitStep, problem: _C.FieldProblem, theta: Tensor) -> Tensor:
    """The mean over the states of (‖u - u_observed‖ / ‖u_observed‖)² over all snapshots."""
    cast(Diffusion, stepper.operator_at).take(theta.exp())
    states = stepper.rollout(problem.start, scene.field.steps)
    if scene.on_failure == "zero_grad" and stepper.info is not None:
        states = detach_failed(states, stepper.info)
    return _C.normalised_mse(_C.observed(states, scene), problem.snapshots)


def make_task(scene: _C.Scene, steppers: list[Stepper], seed: int) -> Task:
    """An interval is a single update, the metric the relative error of κ. A user knows the relative misfit alone."""
    (stepper,) = cast(list[ImplicitStep], steppers)
    problem = _C.make_field_problem(scene, seed)
    theta = problem.theta.clone().requires_grad_()
    optimiser = torch.optim.Adam([theta], lr=scene.learning_rate(0), fused=True)
    relative = 1.0  # before the first solve nothing is explained yet

    def updates(number: int) -> Iterator[tuple[float, Tensor | None]]:
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

    def metric() -> float:
        return float(_C.relative_error(theta.detach().exp(), problem.reference))

    def state() -> dict[str, Tensor]:
        return {"theta": theta.detach(), **state_of(optimiser)}

    def load(saved: _C.Saved, updates: int) -> None:
        theta.detach().copy_(saved.take("theta", theta))
        load_optimiser(saved, optimiser, updates)

    return Task(updates, metric, lambda _: relative, state, load)
