"""The task "field": κ = exp(θ) is found from noisy snapshots of states that it diffuses, or from the pressures of a
Darcy flow."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from prdp_torch import operators
from prdp_torch.experiments import _C
from prdp_torch.experiments.checkpoint import load_optimiser, make_optimiser, state_of
from prdp_torch.experiments.networks import Theta
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

    def follow(self, scene: _C.Scene, stepper: ImplicitStep, start: Tensor) -> Tensor:
        """All states of the initial states `start`."""
        return stepper.rollout(start, scene.field.steps)


class Darcy:
    """-∇·(κ ∇p) = f with p = 0 on the sides of a box, as a step for an `ImplicitStep`: from the pressures of the last
    κ, where the solve may start, to those of this one."""

    def __init__(self, length: Sequence[float]) -> None:
        self.length = length
        self.pressure = torch.empty(0)
        self._sources = torch.empty(0)
        self._assembled: operators.Diffusion | None = None

    def take(self, kappa: Tensor) -> None:
        self._assembled = operators.Diffusion(kappa[None], length=self.length)

    def __call__(self, pressure: Tensor) -> operators.Diffusion:
        assert self._assembled is not None
        return self._assembled

    def rhs(self, pressure: Tensor) -> Tensor:
        return self._sources

    def follow(self, scene: _C.Scene, stepper: ImplicitStep, sources: Tensor) -> Tensor:
        """The pressures of the sources, with an axis as that of snapshots."""
        self._sources = sources
        last = self.pressure if len(self.pressure) else torch.zeros_like(sources)
        pressure: Tensor = stepper(last)
        self.pressure = pressure.detach()
        return pressure.unsqueeze(1)


def make_stepper(scene: _C.Scene, **options: Any) -> ImplicitStep:
    """The step of the scene; its operator needs a κ before the first one."""
    if scene.physics.equation == "darcy":
        darcy = Darcy(scene.physics.length)
        return ImplicitStep(darcy, darcy.rhs, **options)
    return ImplicitStep(Diffusion(scene.physics.dt, scene.physics.length), **options)


def make_darcy_step(scene: _C.Scene, **options: Any) -> ImplicitStep:
    """From log κ, (batch, 1, *shape), to the pressures of -∇·(κ ∇p) = f: what an emulator is trained through."""

    def operator(log_kappa: Tensor) -> operators.Diffusion:
        return operators.Diffusion(log_kappa.squeeze(1).exp(), length=scene.physics.length)

    def sources(log_kappa: Tensor) -> Tensor:
        return torch.full_like(log_kappa, _C.DARCY_SOURCE)

    return ImplicitStep(operator, sources, **options)


def take_reference(scene: _C.Scene, stepper: ImplicitStep) -> Tensor:
    """Give the step of the scene the field that is to be found, whose solves are those at the end of a training. Return
    the states that it steps from: of a Darcy flow, the pressures of the field that the training starts from."""
    problem = _C.make_field_problem(scene, 0)
    equation = cast(Diffusion | Darcy, stepper.operator_at)
    sample = problem.start
    if isinstance(equation, Darcy):
        equation.take(problem.theta.exp())
        sample = equation.follow(scene, stepper, problem.start).squeeze(1)
    equation.take(problem.reference.clone().requires_grad_())
    return sample.detach()


def misfit(scene: _C.Scene, stepper: ImplicitStep, problem: _C.FieldProblem, theta: Tensor) -> Tensor:
    """The mean over the states of (‖u - u_observed‖ / ‖u_observed‖)² over all snapshots."""
    equation = cast(Diffusion | Darcy, stepper.operator_at)
    equation.take(theta.exp())
    states = equation.follow(scene, stepper, problem.start)
    if scene.on_failure == "zero_grad" and stepper.info is not None:
        states = detach_failed(states, stepper.info)
    return _C.normalised_mse(_C.observed(states, scene), problem.snapshots)


def make_task(scene: _C.Scene, steppers: list[Stepper], seed: int, found: Theta) -> Task:
    """An interval is a single update, the metric the relative error of κ. A user knows the relative misfit alone."""
    (stepper,) = cast(list[ImplicitStep], steppers)
    problem = _C.make_field_problem(scene, seed)
    theta = found.begin(problem.theta)
    optimiser = make_optimiser(scene, [theta])
    relative = 1.0  # before the first solve nothing is explained yet

    def updates(number: int) -> Iterator[tuple[float, Tensor | None]]:
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

    def metric() -> float:
        return float(_C.relative_error(theta.detach().exp(), problem.reference))

    equation = stepper.operator_at

    def state() -> dict[str, Tensor]:
        pressure = {"pressure": equation.pressure} if isinstance(equation, Darcy) else {}
        return {"theta": theta.detach(), **pressure, **state_of(optimiser)}

    def load(saved: _C.Saved, updates: int) -> None:
        theta.detach().copy_(saved.take("theta", theta))
        if isinstance(equation, Darcy):
            equation.pressure = saved.take("pressure", problem.start).to(scene.device)
        load_optimiser(saved, optimiser, updates)

    return Task(updates, metric, lambda _: relative, state, load)
