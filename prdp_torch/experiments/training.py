"""The Python trainer. Data, losses and metrics come from the library, the network may be any
`nn.Module`; `csrc/prdp_experiments/training` holds the same loops in C++."""

import contextlib
import functools
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, NotRequired, TypeAlias, TypedDict, cast

import torch

from prdp_torch import data_parallel
from prdp_torch.controller import ToleranceController
from prdp_torch.experiments import _C, datasets, field_task, network_task, parameter_task
from prdp_torch.experiments.checkpoint import Checkpoint, Found, check_tensors, load_random, random_states
from prdp_torch.experiments.networks import Theta
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.reports import any_nonfinite, on_host, spent_on
from prdp_torch.experiments.scenes import make_stepper, placed
from prdp_torch.experiments.task import Task
from prdp_torch.stepper import Stepper


class Interval(NamedTuple):
    """What a callback of `train` gets: one epoch, or one update if there is no network."""

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
    failed: int
    """Samples whose forward or adjoint solve failed, over the updates."""
    seconds: float
    """Of the updates; the validation is not counted."""
    resumed: bool
    """Whether the interval was done earlier, and read from a checkpoint."""


Callback: TypeAlias = Callable[[Interval], object]
"""Stops the training if it returns True, of Python, numpy or torch."""


class Curves(TypedDict):
    """The curves of a training: lists with one entry per interval. `train` says what is in each."""

    update_loss: list[float]
    metric: list[float]
    error: list[float]
    max_iter: list[int]
    budget: list[int]
    iterations: list[float]
    operator_applications: list[float]
    adjoint_applications: list[float]
    rtol: list[float]
    failed: list[int]
    seconds: list[float]
    warning: NotRequired[str]
    diverged: NotRequired[str]


def train(
    scene: _C.Scene,
    refinement: Refinement,
    seed: int = 0,
    network: torch.nn.Module | None = None,
    callbacks: Iterable[Callback] = (),
    on_data: datasets.OnData | None = None,
    checkpoint: Checkpoint | None = None,
    data: datasets.Own = None,
    device: str | torch.device | None = None,
) -> Curves:
    """Train a scene once.

    Args:
        scene: from `prdp_torch.experiments.scenes.load`.
        refinement: a `Refinement`, which chooses K and the tolerance.
        seed: sets the initial weights of the network, the order of the batches and the random numbers of the training,
            such as those of dropout; for the task "field", the noise.
            The data of a scene do not depend on it.
        network: any module that maps (batch, channels, *shape) to the same shape. None makes that of the scene. For the
            tasks "field" and "parameters", a `prdp_torch.experiments.networks.Theta(scene)`, in which what is found is
            left.
        callbacks: functions that are called after each interval with an `Interval`. If one returns True, the
            training stops and its checkpoint is saved. If a training continues from a checkpoint, they are first
            called with the intervals that were done before (`resumed`). A diverged interval makes no call.
        on_data: called while data are made with (steps done, all steps), where steps are counted per sample.
        checkpoint: a `checkpoint.Checkpoint`. The training continues from its state, and saves its own there
            whenever one is due. On the same machine, with as many threads, the result is the same bit for
            bit, also for a network with dropout.
        data: trajectories in place of the scene's data: (samples, times, channels, *shape), spaced by the scene's
            dt, as a tensor, an array or a dataset of trajectories. The first `data.train` of them train, the next
            `data.valid` validate; or give a pair (training, validation). Every state of a training trajectory
            that two more states follow is a sample.
        device: where data, network, optimiser and solves live, such as "cuda" or "cuda:1"; by default the scene's. The
            same seed gives the same data and initial weights on every device. A network of yours is moved there, and
            stays there. A training may continue on another device than its checkpoint is from.

    Returns:
        The curves, a dict of lists with one entry per interval: an epoch, or an update if there is no network.

        - "update_loss": one entry per update.
        - "metric", "error": the validation metric and the relative error. They begin with a value from before the
          first interval.
        - "max_iter", "rtol": K and the tolerance during the interval.
        - "budget": K times the number of solves. The task "corrector" has two solves per update, "field" one per step.
        - "iterations", "operator_applications": per sample of a batch, summed over the solves. The products include
          those of the adjoint solves, which "adjoint_applications" counts alone.
        - "failed": the samples whose forward or adjoint solve failed, over the updates. A line on stderr names them
          after each interval. With the scene's on_failure = "zero_grad" they stay in the loss, without a gradient.
        - "seconds": of the updates.
        - "warning": only if the controller ends with one.
        - "diverged": only if the loss or the metric was no longer finite. It says where and why. The training stops
          there, and the curves end with that interval, with a metric of NaN, and costs of zero unless its updates
          were done.

    Raises:
        ValueError, TypeError: network, data or checkpoint do not fit the scene, or there is no such device here.
            Device, network and data are checked before any work.

    If torch.distributed is initialised, every process calls this with the same arguments. The processes share each
    batch and the validation samples and return the same curves, which are those of one process to rounding. The first
    one keeps the checkpoint. ValueError for a task without a network, and if a batch has fewer samples than there are
    processes. With the device "cuda" each process takes the GPU of its LOCAL_RANK; NCCL sums the gradients if no two
    processes share one.
    """
    if data_parallel.count() > 1 and not scene.trains_network:
        raise ValueError(f"train: several processes share the batches of a network; the task '{scene.task}' has none")
    if not isinstance(refinement, Refinement):
        raise TypeError(f"train: refinement must be a Refinement, such as Refinement.auto(), got {refinement!r}")
    if scene.training.intervals < 1:
        raise ValueError(f"train: scene.training.intervals must be >= 1, got {scene.training.intervals}")
    scene = placed(scene, device)
    if not isinstance(callbacks, Iterable):
        raise TypeError(f"train: callbacks must be a list of functions, got {callbacks!r}")
    callbacks = list(callbacks)
    for callback in callbacks:
        if not callable(callback):
            raise TypeError(f"train: callbacks must be functions of an Interval, got {callback!r}")
    if not scene.trains_network and (data is not None or not isinstance(network, Theta | None)):
        raise ValueError(f"train: the task '{scene.task}' trains no network: it takes no data, and as network a Theta")
    if checkpoint is not None and isinstance(network, torch.nn.Module):
        check_tensors(network)
    found = [] if checkpoint is None else checkpoint.found()
    steppers = [make_stepper(scene, refinement.direct) for _ in range(scene.executions)]
    training = _Run(scene, seed, steppers, refinement, checkpoint, callbacks)
    if scene.trains_network:
        data = data_parallel.first_before_others(functools.partial(datasets.of_scene, scene, data, on_data))
        task = network_task.make_task(scene, steppers, seed, network, data)
    else:
        theta = network if isinstance(network, Theta) else Theta(scene)
        task = (field_task if scene.task == "field" else parameter_task).make_task(scene, steppers, seed, theta)
    try:
        with _repeatable(scene.device, seed):
            training.run(task, found)
    except _Diverged as divergence:
        training.mark_diverged(str(divergence))
    return cast(Curves, training.curves)


@contextlib.contextmanager
def _repeatable(device: torch.device, seed: int) -> Iterator[None]:
    """Convolutions of GPUs that give the same bits each time, and random numbers, as for dropout, that follow from the
    seed: a training that runs again, or continues, ends where the first did. Outside, nothing changes."""
    before = torch.backends.cudnn.deterministic
    torch.backends.cudnn.deterministic = True
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(seed)
            yield
    finally:
        torch.backends.cudnn.deterministic = before


def _is_true(value: object) -> bool:
    """Whether it is True, or that of numpy or of torch."""
    is_of_array = getattr(value, "ndim", None) == 0 and str(getattr(value, "dtype", "")) in ("bool", "torch.bool")
    return (isinstance(value, bool) or is_of_array) and bool(value)


class _Diverged(Exception):
    pass


class _Run:
    """What the tasks share: the intervals, their costs, and when a training is lost."""

    COSTS = (
        "max_iter", "budget", "iterations", "operator_applications", "adjoint_applications", "rtol", "failed", "seconds"
    )  # fmt: skip

    def __init__(
        self,
        scene: _C.Scene,
        seed: int,
        steppers: list[Stepper],
        refinement: Refinement,
        checkpoint: Checkpoint | None,
        callbacks: list[Callback],
    ) -> None:
        self.who = f"{scene.name}, {refinement.label}, seed {seed}"
        self.tolerates_failures = scene.on_failure == "zero_grad"  # past solves that were given NaN or Inf
        self.intervals = scene.training.intervals
        self.device = scene.device
        self.steppers = steppers
        self.controller = refinement.attach(steppers)
        self.watches_error = refinement.watches_error
        self.checkpoint = checkpoint
        self.callbacks = callbacks
        self.curves: dict[str, Any] = {name: [] for name in ("update_loss", "metric", "error", *self.COSTS)}

    def run(self, task: Task, found: Found) -> None:
        stopped = False
        if not self._restore(task, found):
            self._observe(task, 0)
        else:
            for number in range(1, self._done() + 1):
                stopped = self._notify(number, resumed=True)
        while not stopped and self._done() < self.intervals:
            self._run_interval(task, self._done() + 1)
            self._observe(task, self._done())
            checkpoint = self.checkpoint if self._done() < self.intervals else None  # a whole training needs none
            was_due = checkpoint is not None and checkpoint.due()
            if checkpoint is not None and was_due:
                self._save(task, checkpoint)
            stopped = self._notify(self._done())
            if checkpoint is not None and stopped and not was_due:
                self._save(task, checkpoint)
        if self.controller.warning is not None:
            self.curves["warning"] = self.controller.warning

    def _notify(self, number: int, resumed: bool = False) -> bool:
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
        stopped = any([_is_true(callback(interval)) for callback in self.callbacks])  # a list: all of them are called
        return data_parallel.sums([stopped])[0] > 0

    def _done(self) -> int:
        return len(self.curves["seconds"])

    def _save(self, task: Task, checkpoint: Checkpoint) -> None:
        tensors = {**task.state(), **random_states(self.device)}
        checkpoint.save(tensors, self.curves, self.controller.state_dict())

    def _restore(self, task: Task, found: Found) -> bool:
        """Continue from the checkpoint; False where there is none."""
        if self.checkpoint is None or not self.checkpoint.restore(found, functools.partial(self._load, task)):
            return False
        self.checkpoint.check_length(self._done(), self.intervals)
        return True

    def _load(self, task: Task, saved: _C.Saved) -> None:
        """Take the state of this training. ValueError where it is another's; some of it may have been taken."""
        curves, controller = saved.progress(task.updates_per_interval)
        task.load(saved, len(curves["update_loss"]))
        self.controller.load_state_dict({**self.controller.state_dict(), **controller})
        load_random(saved, self.device)
        self.curves = curves

    def _run_interval(self, task: Task, number: int) -> None:
        k, rtol = self.controller.max_iter, self.steppers[0].rtol
        started, solves = time.perf_counter(), 0
        iterations = forward = adjoint = 0.0
        failures = _C.Failures()
        for loss, samples in task.updates(len(self.curves["update_loss"])):
            reports = on_host(stepper.info for stepper in self.steppers)
            adjoints = on_host(stepper.adjoint_info for stepper in self.steppers)
            solves += sum(report.iterations[0].numel() for report in reports)
            known = [loss, any_nonfinite(reports), *spent_on(reports, adjoints)]
            loss, refused, *spent = data_parallel.mean(known, len(reports[0].iterations))
            self._check(loss, refused, number)
            self.curves["update_loss"].append(loss)
            iterations, forward, adjoint = (a + b for a, b in zip((iterations, forward, adjoint), spent, strict=True))
            failures.take([report.status for report in reports], [report.status for report in adjoints], samples)
        seconds = time.perf_counter() - started
        failed = int(data_parallel.sums([failures.count])[0])
        self._append(k, k * solves, iterations, forward + adjoint, adjoint, rtol, failed, seconds)
        if failures.count:
            print(f"prdp: {self.who}, {failures.line(number)}", file=sys.stderr)

    def mark_diverged(self, why: str) -> None:
        """The curves end with the interval that was lost."""
        self.curves["diverged"] = why
        lost = max(1, len(self.curves["metric"]))
        for name in ("metric", "error"):
            self.curves[name] += [math.nan] * (lost + 1 - len(self.curves[name]))
        if self._done() < lost:
            self._append(self.controller.max_iter, 0, 0.0, 0.0, 0.0, self.steppers[0].rtol, 0, 0.0)

    def _append(self, *costs: float) -> None:
        for name, value in zip(self.COSTS, costs, strict=True):
            self.curves[name].append(value)

    def _observe(self, task: Task, done: int) -> None:
        """Append the metric and the error after `done` intervals, and let the controller decide by them."""
        metric = task.metric()
        if not math.isfinite(metric):
            raise _Diverged(f"interval {done}: the metric is {metric}")
        self.curves["metric"].append(metric)
        error = task.error(metric)
        if not math.isfinite(error):
            raise _Diverged(f"interval {done}: the relative error is {error}")
        self.curves["error"].append(error)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what the controller warns of is in the curves
            if self.watches_error or isinstance(self.controller, ToleranceController):
                self.controller.step(error)
            else:
                self.controller.step(metric, error=error)

    def _check(self, loss: float, refused: float, number: int) -> None:
        if not math.isfinite(loss):
            raise _Diverged(f"interval {number}: the loss is {loss}")
        if refused and not self.tolerates_failures:
            raise _Diverged(f"interval {number}: the solver was given NaN or Inf")
