"""The task "parameters": the load of a Poisson problem, from its solution."""

import torch

from prdp_torch.experiments import _C
from prdp_torch.experiments.task import Task


def make_task(scene, steppers, seed):
    """An interval is a single update, the metric the error of θ."""
    (stepper,) = steppers
    problem = _C.make_parameter_problem(scene)
    theta = problem.start.clone().requires_grad_()
    # What a user sees, who does not know θ; before the first solve nothing is explained yet.
    misfit = 1.0

    def updates(number):
        nonlocal misfit
        u = stepper((theta @ problem.modes)[None, None])
        loss = _C.half_mse(u, problem.solution)
        (gradient,) = torch.autograd.grad(loss, theta)
        with torch.no_grad():
            theta.sub_(gradient, alpha=scene.learning_rate(number))
        misfit = float(_C.relative_error(u.detach(), problem.solution))
        yield float(loss.detach()), None

    def metric():
        return float(_C.relative_error(theta.detach(), problem.reference))

    def load(saved, updates):
        theta.detach().copy_(saved.take("theta", theta))

    return Task(updates, metric, lambda _: misfit, lambda: {"theta": theta.detach()}, load)
