"""What controllers decide by after an interval: how its solves ended, and numbers that all processes agree on."""

import math
import weakref
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeGuard

import torch

from prdp_torch import _C, data_parallel
from prdp_torch.solve import SolveInfo, SolveStatus
from prdp_torch.types import Refinable

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup


def all_converged(steppers: list[Refinable]) -> bool:
    """Whether all say so, by a bool of any library: a method, or a value for each sample, is none."""
    said = [getattr(stepper, "converged", None) for stepper in steppers]
    return bool(said) and all((isinstance(x, int) or getattr(x, "shape", None) == ()) and bool(x) for x in said)


_LAST: "weakref.WeakKeyDictionary[Any, weakref.ref[Any]]" = weakref.WeakKeyDictionary()  # who set a stepper last


def has_controller(stepper: torch.nn.Module) -> bool:
    """Whether a controller that lives sets it."""
    last = _LAST.get(stepper)
    return last is not None and last() is not None


def take_over(steppers: list[Refinable], controller: object) -> str | None:
    """Note who sets these steppers now. What to say if another controller has set one since this one did; else None."""
    said = None
    for stepper in steppers:
        if not isinstance(stepper, torch.nn.Module):  # others may be equal, or have no weak references
            continue
        last = _LAST.get(stepper, weakref.ref(controller))()
        _LAST[stepper] = weakref.ref(controller)
        if last is not None and last is not controller:
            said = f"a {type(last).__name__} sets this {type(stepper).__name__}, too: give a stepper one controller"
    return said


_READ = ("residual", "floor", "iterations", "status")


class Ended(NamedTuple):
    """How the last solves of the steppers ended, on the host."""

    residuals: list[tuple[float, float]]  # of each stepper, the sum over samples that did not fail, and their number
    idle: float  # the share of solves that took no iteration, though their residual is not small; the largest
    failed: float  # the share of samples that failed; the largest

    @classmethod
    def of(cls, steppers: list[Refinable]) -> Self:
        residuals, idle, failed = [], [0.0], [0.0]
        for info in (getattr(stepper, "info", None) for stepper in steppers):
            if not _is_report(info):  # it has not solved yet, or is of somebody else's kind
                residuals.append((0.0, 0.0))
                continue
            parts = torch.stack([part.double() for part in (info.residual, info.floor, info.iterations, info.status)])
            residual, floor, iterations, status = parts.cpu()  # one copy of a device
            residual = residual.masked_fill(floor > 0, 0.0)  # it is rounding alone
            counted = residual[status >= SolveStatus.STAGNATED]
            residuals.append((float(counted.sum()), float(counted.numel())))
            is_idle = ((iterations == 0) & (status > 0) & (residual > _C.SMALL_RESIDUAL)).double()  # K may be 0
            has_failed = (status < SolveStatus.STAGNATED).double()
            for shares, of_samples in ((idle, is_idle), (failed, has_failed)):
                shares.append(float(of_samples.mean()) if of_samples.numel() else 0.0)
        return cls(residuals, max(idle), max(failed))


def _is_report(info: Any) -> TypeGuard[SolveInfo]:
    return all(isinstance(getattr(info, name, None), torch.Tensor) for name in _READ)


class Interval(NamedTuple):
    """What a controller decides by: the arguments of `_C.Controller._step`, the same in every process."""

    metric: float  # the mean over the processes, as `error`, `idle` and `failed` are
    converged: bool  # in all processes
    residual: float | None  # where the last solves ended: the mean over the samples, the largest of several steppers
    error: float | None
    idle: float
    failed: float

    @classmethod
    def of_processes(
        cls,
        metric: float,
        converged: bool,
        error: float | None,
        ended: Ended,
        group: "ProcessGroup | None",
        agreed: Mapping[str, float | None],
    ) -> Self:
        """`agreed` is what a controller has the same in every process, or RuntimeError in all of them."""
        residuals, idle, failed = ended
        processes = data_parallel.count(group)
        if processes > 1:
            # A number that is refused must be refused in every process.
            numbers = [math.nan if x < 0 else x for x in (metric, 0.0 if error is None else error)]
            numbers += [converged, error is not None, idle, failed]
            same = [-1.0 if value is None else value for value in agreed.values()]  # no setting is negative
            rows = data_parallel.gathered([*same, *numbers, *(number for pair in residuals for number in pair)], group)
            for name, *values in zip(agreed, *rows, strict=False):
                if len(set(values)) > 1:
                    different = " and ".join("None" if x < 0 else f"{x:g}" for x in sorted(set(values)))
                    raise RuntimeError(
                        f"the controllers of {processes} processes disagree: {name} is {different}; make them with "
                        "the same settings, and load a state in every process"
                    )
            sums = [sum(column) for column in zip(*(row[len(same) :] for row in rows), strict=True)]
            metric_sum, error_sum, agree, known, idle_sum, failed_sum, *flat = sums
            refused = not (math.isfinite(metric) and metric >= 0)  # here, which the error is to say
            metric = metric if refused else metric_sum / processes
            converged, idle, failed = agree == processes, idle_sum / processes, failed_sum / processes
            error = error_sum / processes if known == processes else None
            residuals = list(zip(flat[::2], flat[1::2], strict=True))
        means = [total / samples for total, samples in residuals if samples]
        return cls(metric, converged, max(means, default=None), error, idle, failed)
