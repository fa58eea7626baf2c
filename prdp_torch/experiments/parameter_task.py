"""The task "parameters": the load of a Poisson problem, from its solution."""

from collections.abc import Iterator

import torch
from torch import Tensor

from prdp_torch.experiments import _C
from prdp_torch.experiments.networks import Theta
from prdp_torch.experiments.task import Task
from prdp_torch.stepper import Stepper


def make_task(scene: _C.Scene, steppers: list[Stepper], seed: int, found: Theta) -> Task:
    """An interval is a single update, the metric the error of θ."""
    (stepper,) = steppers
    problem = _C.make_parameter_problem(scene)
    theta = found.begin(problem.start)
    # What a user sees, who does not know θ; before the first solve nothing is explained yet.
    misfit = 1.0

    def updates(number: int) -> Iterator[tuple[float, Tensor | None]]:
        nonlocal misfit
        u = stepper((theta[None] @ problem.modes)[None])
        loss = _C.half_mse(u, problem.solution)
        (gradient,) = torch.autograd.grad(loss, theta)
        with torch.no_grad():
            theta.sub_(gradient, alpha=scene.learning_rate(number))
        misfit = float(_C.relative_error(u.detach(), problem.solution))
        yield float(loss.detach()), None

    def metric() -> float:
        return float(_C.relative_error(theta.detach(), problem.reference))

    def load(saved: _C.Saved, updates: int) -> None:
        theta.detach().copy_(saved.take("theta", theta))

    return Task(updates, metric, lambda _: misfit, lambda: {"theta": theta.detach()}, load)
