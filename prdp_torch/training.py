"""The Python trainer. Data, losses and metrics come from the library, the network may be any
`nn.Module`; `csrc/train` holds the same loops in C++."""

import math
import time
from typing import NamedTuple

import torch

from prdp_torch import _C, field_task, fields
from prdp_torch.controller import LinearSchedule, PRDPController, ToleranceController
from prdp_torch.networks import make_network
from prdp_torch.scenes import make_stepper
from prdp_torch.solve import SolveStatus
from prdp_torch.task import Task


class Refinement:
    """How a training decides how far the solver goes.

    Args:
        label: for the records.
        attach: called with the steppers; sets them up and returns their controller.
        direct: the exact solver in place of the scene's.
        watches_error: whether the controller's `step` takes the relative error, not the metric.
    """

    def __init__(self, label, attach, direct=False, watches_error=False):
        self.label = label
        self.attach = attach
        self.direct = direct
        self.watches_error = watches_error

    @classmethod
    def auto(cls):
        """What fits every scene with nothing chosen for it; docs/refinement.md says why."""

        def attach(steppers):
            for stepper in steppers:
                stepper.start = "state"
            return ToleranceController(steppers)

        return cls("auto", attach, watches_error=True)

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
    def tolerance(cls, rtol, k):
        """The same rtol throughout; K is a cap."""

        def attach(steppers):
            for stepper in steppers:
                stepper.rtol = rtol
            return LinearSchedule(steppers, initial=k, increment=0, maximum=k)

        return cls(f"rtol_{rtol:g}", attach)

    @classmethod
    def schedule(cls, start, step, maximum, label=None):
        return cls(
            label or f"schedule_{start}_{step}",
            lambda steppers: LinearSchedule(steppers, initial=start, increment=step, maximum=maximum),
        )

    @classmethod
    def exact(cls):
        return cls("direct", lambda steppers: LinearSchedule(steppers, initial=1, increment=0, maximum=1), direct=True)


class Interval(NamedTuple):
    """What a callback of `train` is told: one epoch, or one update where there is no network."""

    number: int
    """Counted from 1."""
    intervals: int
    """How many the training has."""
    loss: float
    """The mean over the updates."""
    metric: float
    """The validation metric after the interval."""
    error: float
    """The relative error of what is trained, as a user knows it."""
    max_iter: int
    """K during the interval."""
    rtol: float
    """The tolerance during the interval."""
    iterations: float
    """Solver iterations per sample, summed over the updates."""
    operator_applications: float
    """Products with A per sample, summed over the updates, forward and adjoint."""
    adjoint_applications: float
    """Those of the adjoint solves."""
    seconds: float
    """Of the updates; the validation is not counted."""
    resumed: bool
    """Whether the interval was done earlier, and read from a checkpoint."""


def train(scene, refinement, seed=0, network=None, callbacks=(), on_data=None, checkpoint=None):
    """Train the scene once. Returns the curves as a dict of lists, one entry an interval: an epoch, or
    an update where there is no network. "metric" starts before the first interval, and so does "error", the
    relative error that a user knows; "budget" is K times the solves, of which an update of the task "corrector"
    has two and one of "field" one a step; iterations and operator applications are per sample of a batch, summed
    over the solves, the applications over the adjoint solves as well, whose own are "adjoint_applications".
    "warning" is there where the controller ends with one.
    A training whose loss or metric is no longer finite stops there: "diverged" says where and why, and the
    curves end with the interval that was lost, with a metric of NaN and no costs.

    Args:
        scene: from `prdp_torch.scenes.load`.
        refinement: a `Refinement`.
        seed: of the network's weights and of the shuffling, or of a field's noise; the other data stay the same.
        network: any module from (batch, channels, *shape) to the same shape; the scene's own where None.
        callbacks: functions that are called after each interval with an `Interval`. If one returns True, the
            training stops there, and its checkpoint is saved. A training that goes on from a checkpoint first calls
            them with the intervals that are done already (`resumed`). No call is made for a diverged interval.
        on_data: called while data are made that are not on disk yet, with (steps of a sample done, all of them).
        checkpoint: a `prdp_torch.checkpoint.Checkpoint` to go on from where it has a state, bit for bit on
            the same machine with as many threads, and to keep the training in whenever it is due. It holds torch's
            global random state as well, for a network with dropout. ValueError for a state that does not fit the
            scene and the network, or has more intervals than the scene.
    """
    callbacks = list(callbacks)
    for callback in callbacks:
        if not callable(callback):
            raise TypeError(f"train: callbacks must be functions of an Interval, got {callback!r}")
    saved = None if checkpoint is None else checkpoint.load()
    steppers = [make_stepper(scene, refinement.direct) for _ in range(scene.executions)]
    run = _Run(scene.training.intervals, steppers, refinement, checkpoint, callbacks)
    if scene.trains_network:
        task = _network(scene, steppers, seed, network, on_data)
    else:
        task = (field_task.make_task if scene.task == "field" else _parameters)(scene, steppers, seed)
    try:
        run.go(task, saved)
    except _Diverged as divergence:
        run.give_up(str(divergence))
    return run.curves


class _Diverged(Exception):
    pass


class _Run:
    """What the tasks share: the intervals, their costs, and when a training is lost."""

    COSTS = (
        "max_iter", "budget", "iterations", "operator_applications", "adjoint_applications", "rtol", "seconds"
    )  # fmt: skip

    def __init__(self, intervals, steppers, refinement, checkpoint, callbacks):
        self.intervals = intervals
        self.steppers = steppers
        self.controller = refinement.attach(steppers)
        self.watches_error = refinement.watches_error
        self.checkpoint = checkpoint
        self.callbacks = callbacks
        self.curves = {name: [] for name in ("update_loss", "metric", "error", *self.COSTS)}

    def go(self, task, saved):
        stopped = False
        if saved is None:
            self._observe(task, 0)
        else:
            self._restore(task, saved)
            for number in range(1, self._done() + 1):
                stopped = self._tell(number, resumed=True)
        while not stopped and self._done() < self.intervals:
            self._run_interval(task, self._done() + 1)
            self._observe(task, self._done())
            unfinished = self.checkpoint is not None and self._done() < self.intervals
            kept = unfinished and self.checkpoint.due()
            if kept:
                self._keep(task)
            stopped = self._tell(self._done())
            if stopped and unfinished and not kept:
                self._keep(task)
        if self.controller.warning is not None:
            self.curves["warning"] = self.controller.warning

    def _tell(self, number, resumed=False):
        """Call the callbacks with an interval. True if one of them stops the training."""
        curves, updates = self.curves, len(self.curves["update_loss"]) // self._done()
        losses = curves["update_loss"][(number - 1) * updates : number * updates]
        costs = {name: curves[name][number - 1] for name in self.COSTS if name != "budget"}
        interval = Interval(
            number=number,
            intervals=self.intervals,
            loss=sum(losses) / updates,
            metric=curves["metric"][number],
            error=curves["error"][number],
            resumed=resumed,
            **costs,
        )
        return any([callback(interval) is True for callback in self.callbacks])  # a list: all of them are called

    def _done(self):
        return len(self.curves["seconds"])

    def _keep(self, task):
        controller = self.controller.state_dict()
        state = {"task": task.state(), "controller": controller, "curves": self.curves}
        self.checkpoint.save({**state, "random": torch.get_rng_state()})

    def _restore(self, task, saved):
        try:
            task.load(saved["task"])
            self.controller.load_state_dict(saved["controller"])
            torch.set_rng_state(saved["random"])
            self.curves = saved["curves"]
            done = self._done()
        except (RuntimeError, KeyError, TypeError, ValueError):
            self.checkpoint.refuse()
        self.checkpoint.check_length(done, self.intervals)

    def _run_interval(self, task, number):
        k, rtol = self.controller.max_iter, self.steppers[0].rtol
        started, solves = time.perf_counter(), 0
        iterations = forward = adjoint = 0.0
        for loss in task.updates(len(self.curves["update_loss"])):
            self._check(loss, number)
            self.curves["update_loss"].append(loss)
            for stepper in self.steppers:
                solves += stepper.info.iterations[0].numel()
                iterations += _per_sample(stepper.info.iterations)
                forward += _per_sample(stepper.info.operator_applications)
                if stepper.adjoint_info is not None:
                    adjoint += _per_sample(stepper.adjoint_info.operator_applications)
        seconds = time.perf_counter() - started
        self._append(k, k * solves, iterations, forward + adjoint, adjoint, rtol, seconds)

    def give_up(self, why):
        """The curves end with the interval that was lost."""
        self.curves["diverged"] = why
        lost = max(1, len(self.curves["metric"]))
        for name in ("metric", "error"):
            self.curves[name] += [math.nan] * (lost + 1 - len(self.curves[name]))
        if self._done() < lost:
            self._append(self.controller.max_iter, 0, 0.0, 0.0, 0.0, self.steppers[0].rtol, 0.0)

    def _append(self, *costs):
        for name, value in zip(self.COSTS, costs, strict=True):
            self.curves[name].append(value)

    def _observe(self, task, done):
        metric = task.metric()
        if not math.isfinite(metric):
            raise _Diverged(f"interval {done}: the metric is {metric}")
        self.curves["metric"].append(metric)
        error = task.error(metric)
        self.curves["error"].append(error)
        if self.watches_error:
            self.controller.step(error)
        else:
            self.controller.step(metric, error=error)

    def _check(self, loss, done):
        if not math.isfinite(loss):
            raise _Diverged(f"interval {done}: the loss is {loss}")
        if any(bool((stepper.info.status <= SolveStatus.NONFINITE_INPUT).any()) for stepper in self.steppers):
            raise _Diverged(f"interval {done}: the solver was given NaN or Inf")


def _per_sample(counts):
    """Of counts (batch,), or (batch, steps) of a rollout, summed over the steps."""
    return float(counts.double().mean(0).sum())


def propagator(scene, network):
    """A trained network as a step u → u_next: the network itself, or (task "corrector") a converged step
    of the coarse solver with the network on top."""
    if scene.task == "emulator":
        return network
    converged = make_stepper(scene, max_iter=scene.data.valid_max_iter)
    return lambda u: _corrected(converged, network, u)


def error(scene, u, reference):
    """The mean over the samples of (‖u - reference‖ / ‖reference‖)², of a corrector of the velocity along
    x: what the validation metric says at its step."""
    of = slice(0, 1) if scene.task == "corrector" else slice(None)
    return float(_C.normalised_mse(u[:, of], reference[:, of]))


def _network(scene, steppers, seed, network, on_data):
    """An interval is an epoch, the metric that of validation."""
    data = _C.make_dataset(scene, on_data)
    network = make_network(scene, seed) if network is None else network
    objective = _emulator if scene.task == "emulator" else _corrector
    loss_of = objective(scene, steppers, data, network)
    optimiser = torch.optim.Adam(network.parameters(), lr=scene.learning_rate(0), fused=True)
    generator = torch.Generator().manual_seed(seed)

    def updates(first):
        order = torch.randperm(len(data.train_start), generator=generator)
        for number, batch in enumerate(order.split(scene.training.batch), first):
            for group in optimiser.param_groups:
                group["lr"] = scene.learning_rate(number)
            optimiser.zero_grad()
            loss = loss_of(batch)
            loss.backward()
            optimiser.step()
            yield float(loss.detach())

    def state():
        parts = {"network": network.state_dict(), "optimiser": optimiser.state_dict()}
        return {**parts, "shuffling": generator.get_state()}

    def load(saved):
        network.load_state_dict(saved["network"])
        optimiser.load_state_dict(saved["optimiser"])
        generator.set_state(saved["shuffling"])

    # The metric is a mean of squares, relative to the reference, after so many steps; their errors add up.
    def of_a_step(metric):
        return math.sqrt(metric) / scene.data.valid_steps

    return Task(updates, _metric(scene, data, network), of_a_step, state, load)


def _metric(scene, data, network):
    step = propagator(scene, network)

    def metric():
        with torch.no_grad():
            reached = fields.rollout(step, data.valid_start, scene.data.valid_steps)[:, -1]
        return error(scene, reached, data.valid_end)

    return metric


def _emulator(scene, steppers, data, network):
    """The loss of a batch: the network in place of the equation."""
    (stepper,) = steppers

    def loss(batch):
        u2 = stepper(network(data.train_start[batch]))
        return _C.loss(scene.training.loss, u2, data.train_end[batch])

    return loss


def _corrected(stepper, network, u):
    coarse = _C.without_mean_pressure(stepper(u))
    return coarse + network(coarse)


def _corrector(scene, steppers, data, network):
    """The loss of a batch: the network on top of a coarse step, twice."""
    first, second = steppers

    def loss(batch):
        u1 = _corrected(first, network, data.train_start[batch])
        u2 = _corrected(second, network, u1)
        kind = scene.training.loss
        return _C.loss(kind, u1, data.train_first[batch]) + _C.loss(kind, u2, data.train_end[batch])

    return loss


def _parameters(scene, steppers, seed):
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
        yield float(loss.detach())

    def metric():
        return float(_C.relative_error(theta.detach(), problem.reference))

    def load(saved):
        theta.detach().copy_(saved["theta"])

    return Task(updates, metric, lambda _: misfit, lambda: {"theta": theta.detach()}, load)
