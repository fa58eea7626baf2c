"""The Python trainer. Data, losses and metrics come from the library, the network may be any
`nn.Module`; `csrc/train` holds the same loops in C++."""

import math
import time

import torch

from prdp_torch import _C
from prdp_torch.controller import LinearSchedule, PRDPController
from prdp_torch.networks import make_network
from prdp_torch.scenes import make_stepper
from prdp_torch.solve import SolveStatus


class Refinement:
    """How a training chooses K: `label` for the records, `attach` to make the controller."""

    def __init__(self, label, attach, direct=False):
        self.label = label
        self.attach = attach
        self.direct = direct

    @classmethod
    def prdp(cls, scene, growth=None):
        settings = dict(scene.prdp)
        if growth is not None:
            settings["growth"] = growth
        label = "prdp" if growth is None else f"prdp_growth_{growth:g}"
        return cls(label, lambda steppers: PRDPController(steppers, **settings))

    @classmethod
    def constant(cls, k):
        return cls.schedule(k, 0, k, label=f"constant_{k}")

    @classmethod
    def schedule(cls, start, step, maximum, label=None):
        return cls(
            label or f"schedule_{start}_{step}",
            lambda steppers: LinearSchedule(steppers, initial=start, increment=step, maximum=maximum),
        )

    @classmethod
    def exact(cls):
        return cls("direct", lambda steppers: LinearSchedule(steppers, initial=1, increment=0, maximum=1), direct=True)


def train(scene, refinement, seed=0, network=None, on_interval=None):
    """Train the scene once. Returns the curves as a dict of lists, one entry an interval: an epoch, or
    an update of the task "parameters". "metric" starts before the first interval; "budget" is K times
    the updates; iterations and operator applications are per sample of a batch, summed over updates.
    A training whose loss or metric is no longer finite stops there: "diverged" says where and why, the
    metric is NaN from then on, and nothing more is counted.

    Args:
        scene: from `prdp_torch.scenes.load`.
        refinement: a `Refinement`.
        seed: of the network's weights and of the shuffling; the data stay the same.
        network: any module from (batch, channels, *shape) to the same shape; the scene's own where None.
        on_interval: called after each interval with (how many are done, the metric, K).
    """
    stepper = make_stepper(scene, refinement.direct)
    run = _Run(scene.training.intervals, stepper, refinement.attach([stepper]))
    task = _emulator if scene.task == "emulator" else _parameters
    updates, metric = task(scene, stepper, seed, network)
    try:
        run.go(updates, metric, on_interval or (lambda *report: None))
    except _Diverged as divergence:
        run.give_up(str(divergence))
    return run.curves


class _Diverged(Exception):
    pass


class _Run:
    """What the tasks share: the intervals, their costs, and when a training is lost."""

    def __init__(self, intervals, stepper, controller):
        self.intervals = intervals
        self.stepper = stepper
        self.controller = controller
        names = ("update_loss", "metric", "max_iter", "budget", "iterations", "operator_applications", "seconds")
        self.curves = {name: [] for name in names}

    def go(self, updates, metric, on_interval):
        self._observe(metric(), 0)
        for done in range(1, self.intervals + 1):
            k, started, count = self.stepper.max_iter, time.perf_counter(), 0
            iterations = applications = 0.0
            for loss in updates():
                count += 1
                self._check(loss, done)
                self.curves["update_loss"].append(loss)
                iterations += float(self.stepper.info.iterations.double().mean())
                for report in (self.stepper.info, self.stepper.adjoint_info):
                    if report is not None:
                        applications += float(report.operator_applications.double().mean())
            self._append(k, k * count, iterations, applications, time.perf_counter() - started)
            self._observe(metric(), done)
            on_interval(done, self.curves["metric"][-1], self.stepper.max_iter)

    def give_up(self, why):
        self.curves["diverged"] = why
        self.curves["metric"] += [math.nan] * (self.intervals + 1 - len(self.curves["metric"]))
        while len(self.curves["seconds"]) < self.intervals:
            self._append(self.stepper.max_iter, 0, 0.0, 0.0, 0.0)

    def _append(self, *costs):
        for name, value in zip(
            ("max_iter", "budget", "iterations", "operator_applications", "seconds"), costs, strict=True
        ):
            self.curves[name].append(value)

    def _observe(self, metric, done):
        if not math.isfinite(metric):
            raise _Diverged(f"interval {done}: the metric is {metric}")
        self.curves["metric"].append(metric)
        self.controller.step(metric)

    def _check(self, loss, done):
        if not math.isfinite(loss):
            raise _Diverged(f"interval {done}: the loss is {loss}")
        if bool((self.stepper.info.status <= SolveStatus.NONFINITE_INPUT).any()):
            raise _Diverged(f"interval {done}: the solver was given NaN or Inf")


def _emulator(scene, stepper, seed, network):
    """The updates of one epoch, as an iterator over their losses, and the validation metric."""
    data = _C.make_dataset(scene)
    network = make_network(scene, seed) if network is None else network
    optimiser = torch.optim.Adam(network.parameters(), lr=scene.learning_rate(0), fused=True)
    generator = torch.Generator().manual_seed(seed)
    done = 0

    def updates():
        nonlocal done
        for batch in torch.randperm(len(data.train_start), generator=generator).split(scene.training.batch):
            for group in optimiser.param_groups:
                group["lr"] = scene.learning_rate(done)
            optimiser.zero_grad()
            u2 = stepper(network(data.train_start[batch]))
            loss = _C.loss(scene.training.loss, u2, data.train_end[batch])
            loss.backward()
            optimiser.step()
            done += 1
            yield float(loss.detach())

    def metric():
        with torch.no_grad():
            u = data.valid_start
            for _ in range(scene.data.valid_steps):
                u = network(u)
            return float(_C.normalised_mse(u, data.valid_end))

    return updates, metric


def _parameters(scene, stepper, seed, network):
    """The single update of an interval, as an iterator over its loss, and the error of θ."""
    problem = _C.make_parameter_problem(scene)
    theta = problem.start.clone().requires_grad_()
    done = 0

    def updates():
        nonlocal done
        u = stepper((theta @ problem.modes)[None, None])
        loss = _C.half_mse(u, problem.solution)
        (gradient,) = torch.autograd.grad(loss, theta)
        with torch.no_grad():
            theta.sub_(gradient, alpha=scene.learning_rate(done))
        done += 1
        yield float(loss.detach())

    def metric():
        return float(_C.relative_error(theta.detach(), problem.reference))

    return updates, metric
