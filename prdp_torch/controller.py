"""Controllers: they choose K or the tolerance of the solves after each training interval."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, Unpack

from prdp_torch import _C, _check, data_parallel
from prdp_torch.calls import between_graphs
from prdp_torch.controller_interval import Ended, Interval, all_converged, take_over
from prdp_torch.controller_records import PRDPSettings, Record, ToleranceRecord, ToleranceSettings
from prdp_torch.types import Number, Refinable, Steppers

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup

    _Compiled = _C.Controller
else:
    _Compiled = object  # the controllers have the compiled one as their first base


R = TypeVar("R")
Row: TypeAlias = tuple[float, float, int, bool, float | None, float | None]
"""What the compiled controllers keep of a call of `step`, as a `Record` has it."""

PATIENCE, LONG_PATIENCE = 5, 30
"""A `warning` is said aloud after so many intervals without a refinement, or so many intervals in all."""


class _Attached(_Compiled):
    """What controllers share: they hand K and tolerances on to the steppers, and ask them how the solves went."""

    steppers: list[Refinable]
    process_group: "ProcessGroup | None"
    _warned_for: int  # intervals
    _warned_unrefined_for: int  # of these, those since the last refinement
    _has_spoken: bool

    if TYPE_CHECKING:  # each compiled controller has its own

        @property
        def settings(self) -> dict[str, Any]: ...

    def _take(self, steppers: Steppers, process_group: "ProcessGroup | None") -> None:
        who = type(self).__name__
        if process_group is not None and data_parallel.rank(who, process_group) < 0:
            raise ValueError(f"{who}: this process does not belong to process_group")
        self.process_group = process_group
        self._warned_for, self._warned_unrefined_for, self._has_spoken, self._has_said_who = 0, 0, False, False
        self._records: list[Any] = []  # what `history` has returned
        if not isinstance(steppers, Iterable):
            raise TypeError(f"{who}: steppers must be a list such as [heat], got {steppers!r}")
        self.steppers = list(steppers)
        for stepper in self.steppers:
            for name, value in self._budget.items():
                if value is not None and not hasattr(stepper, name):
                    raise TypeError(f"{who}: a stepper must have {name}, got {stepper!r}")
        take_over(self.steppers, self)
        self._push()

    if not TYPE_CHECKING:

        def __setattr__(self, name: str, value: object) -> None:
            if type(self).__module__ == __name__ and name in self.settings:
                raise AttributeError(f"{type(self).__name__}: {name} cannot be set later; make a new controller")
            super().__setattr__(name, value)

    def _push(self) -> None:
        for name, value in self._budget.items():
            for stepper in self.steppers if value is not None else ():
                if getattr(stepper, name) != value:  # to set one takes a check of all settings
                    setattr(stepper, name, value)

    def _decide(self, metric: float, converged: bool | None, error: float | None) -> bool:
        """One step of the compiled controller, and what follows from it for the steppers."""
        if (said := take_over(self.steppers, self)) and not self._has_said_who:
            self._has_said_who = True
            _C.warn(f"{type(self).__name__}: {said}")
        if converged is None:
            converged = all_converged(self.steppers)
        ended = Ended.of(self.steppers)
        agreed = {"max_iter": self.max_iter, "checkpoint": self._checkpoint, **self.settings}
        refined = self._step(*Interval.of_processes(metric, bool(converged), error, ended, self.process_group, agreed))
        self._push()
        self._speak(refined)
        return refined

    def _speak(self, refined: bool) -> None:
        """Say once what `warning` says, if a few intervals have not ended it."""
        warning = self.warning
        self._warned_for = 0 if warning is None else self._warned_for + 1
        self._warned_unrefined_for = 0 if warning is None or refined else self._warned_unrefined_for + 1
        lasts = self._warned_unrefined_for == PATIENCE or self._warned_for == LONG_PATIENCE
        if lasts and not self._has_spoken:
            self._has_spoken = True
            _C.warn(f"{warning} (said once; `.warning` has the state of the last interval)")

    def _recorded(self, record: Callable[[Row, R | None], R]) -> list[R]:
        """The history, of `record(row, the one before)` each. Those made before are kept, as loops read the last."""
        for row in self._history_from(len(self._records)):
            self._records.append(record(row, self._records[-1] if self._records else None))
        return list(self._records)

    def state_dict(self) -> dict[str, Any]:
        """Return the state as plain values, for `load_state_dict`."""
        state = {"max_iter": self.max_iter, "checkpoint": self._checkpoint, "history": self._history_from(0)}
        return {"controller": _kind(type(self)), **state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict()` exactly. ValueError for anything else."""
        wanted = self.state_dict().keys()
        if not isinstance(state, dict) or state.keys() != wanted:
            raise ValueError(f"{type(self).__name__}: expected a state of {', '.join(wanted)}, got {state!r:.80}")
        if state["controller"] != _kind(type(self)):
            raise ValueError(f"{type(self).__name__}: expected its own state, got one of a {state['controller']}")
        try:
            self._load(**{name: value for name, value in state.items() if name != "controller"})
        except TypeError:
            raise ValueError(
                f"{type(self).__name__}: expected a state as state_dict() returns it, got {state!r:.80}"
            ) from None
        self._records = []
        self._push()

    def __reduce__(self) -> tuple[Any, ...]:
        if self.process_group is not None:
            raise TypeError(f"{type(self).__name__}: only a controller of the default process group can be copied")
        return _remade, (type(self), self.steppers, self.settings, self.state_dict())


def _kind(controller: type) -> str:
    """Which of the controllers of this module it is, or is derived from."""
    return next(base.__name__ for base in controller.__mro__ if base.__module__ == __name__)


def _remade(
    kind: Callable[..., _Attached], steppers: Steppers, settings: dict[str, Any], state: dict[str, Any]
) -> _Attached:
    """A copy of a controller."""
    controller = kind(steppers, **settings)
    controller.load_state_dict(state)
    return controller


def _number(who: str, name: str, value: Any) -> float:
    """A metric as a float; a tensor or an array of one element is one."""
    shape = getattr(value, "shape", None)
    return _check.real(who, name, value.item() if shape is not None and math.prod(shape) == 1 else value)


def _checked(who: str, settings: Mapping[str, object], defaults: dict[str, Any]) -> dict[str, Any]:
    """The settings over the defaults: whole numbers where named so here, else real ones, or the default itself."""
    whole = {"delta", "window", "initial", "increment", "maximum"}
    for name, value in settings.items():
        if name not in defaults:
            raise TypeError(f"{who}: unknown setting '{name}'; allowed: {', '.join(defaults)}")
        check = _check.whole if name in whole else _check.real
        if value is not defaults[name]:
            check(who, name, value)
    return {**defaults, **settings}


class PRDPController(_C.PRDPController, _Attached):
    """Progressively Refined Differentiable Physics: raise K when the metric stops improving, until raising it no
    longer helps.

    Args:
        steppers: the steppers whose `max_iter` is set to K, now and after each refinement. It may be empty; then
            read `.max_iter` yourself.
        tau_step: τ_step, 0.95 by default. The metric is on a plateau where L̃[-1]/L̃[-δ] > tau_step. L̃ is its
            exponential mean.
        tau_stop: τ_stop, 0.9. On a plateau K is raised if L̃[-1] < tau_stop · (L̃ at the last refinement), or if the
            metric has grown since then.
        delta: δ >= 2, 3 by default: how many values the plateau test looks back.
        window: length of the exponential mean L̃, with α = 2/(window + 1); 6 by default, and 1 does not smooth.
        initial, increment: K at the start, and how much a refinement adds; both 1.
        maximum: K is never raised beyond it. None, the default, sets no limit.
        growth: a refinement raises K to growth·K where that is more than K + increment; 1.0.
        adjoint_ratio: the adjoint solve gets ⌈adjoint_ratio·K⌉ iterations. None, the default, leaves them to the
            stepper.
        process_group: a group of torch.distributed; None takes the default one. If torch.distributed is initialised,
            `step` is a collective call. Every process calls it with the metric of its own samples, all of them see the
            mean, and they refine in the same interval. On a single process it has no effect.

    K is not raised while every solve of the steppers meets its tolerance. It is raised if the metric grows, as on a
    plateau.

    Every controller has a `warning`. It is None, or a sentence about each of these that holds. It becomes a
    `UserWarning`, once, if it lasts five intervals without a refinement, or thirty with some:

    - The solves stop so far from the solution that their error dominates what is trained.
    - Most of the last solves failed, or took no iteration though their residual is above 1e-4.
    - The metric grows: it was more than twice its least value, three times in a row.
    - The last `step` raised an error for its metric.

    Raises:
        ValueError, TypeError: a setting or a metric is out of range or of a wrong type.

    Examples:
        >>> controller = prdp.PRDPController([heat], tau_stop=0.9)
        >>> refined = controller.step(validation_metric)  # after each epoch

    Source: paper, section 3.
    """

    def __init__(
        self,
        steppers: Steppers = (),
        *,
        process_group: "ProcessGroup | None" = None,
        **settings: Unpack[PRDPSettings],
    ) -> None:
        super().__init__(**_checked("PRDPController", settings, _C.PRDP_DEFAULTS))
        self._take(steppers, process_group)

    @between_graphs
    def step(self, metric: Number, converged: bool | None = None, error: Number | None = None) -> bool:
        """Decide after an interval. Returns True if K was raised.

        `warning` looks at `info` of the steppers' last solves: validate with steps of their own.

        Args:
            metric: of the interval; finite, >= 0, and smaller is better.
            converged: whether the solves meet their tolerance. None asks the steppers.
            error: the relative error of what is trained, if you know it, as in `ToleranceController.step`.
                `warning` compares it with the residual of the solves.
        """
        error = None if error is None else _number("PRDPController", "error", error)
        return self._decide(_number("PRDPController", "metric", metric), converged, error)

    @property
    def history(self) -> list[Record]:
        """Every call of `step` as a `Record`."""
        return self._recorded(lambda row, _: Record(*row))

    def __repr__(self) -> str:
        settings = ", ".join(f"{name}={value:g}" for name, value in self.settings.items() if value is not None)
        smoothed = f"{self.history[-1].smoothed:.3e}" if self.history else "none yet"
        return f"PRDPController(max_iter={self.max_iter}, smoothed metric {smoothed}; {settings})"


class ToleranceController(_C.ToleranceController, _Attached):
    """Tie the tolerance of the solves to the error of what is trained.

    While a network is wrong by a fifth, a solve with a relative residual of a fiftieth is accurate enough. As the
    error falls, the tolerance follows. Use this controller unless you have tuned `PRDPController` for your problem.

    Args:
        steppers: the steppers whose `rtol`, `adjoint_rtol`, `max_iter` and `adjoint_max_iter` are set, now and
            after every step. It may be empty; then read `.rtol`, `.adjoint_rtol` and `.max_iter` yourself.
        ratio: rtol = ratio · min(1, smallest relative error so far), in (0, 1), 0.1 by default; rtol is 1e-3 before the
            first `step`.
        adjoint_ratio: the rtol of the adjoint solve is min(1/10, rtol / adjoint_ratio), but at least rtol and
            adjoint_floor, and its K is ⌈adjoint_ratio·K⌉; in (0, 1], 0.1 by default.
        floor: the smallest rtol; in (0, 1), 1e-5 by default, which solves in float32 reach.
        adjoint_floor: the smallest rtol of the adjoint solve; in (0, 1), 0.01 by default. That rtol is relative to a
            cotangent that shrinks with the error, and a descent needs no better gradient late than early.
        maximum: K >= 1, 10,000 by default. It is only a limit, which the solves should not reach.
        process_group: as for `PRDPController`. The error is averaged over the processes.

    Raises:
        ValueError, TypeError: a setting or an error is out of range or of a wrong type.

    Examples:
        >>> heat = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=1))
        >>> controller = prdp.ToleranceController([heat])
        >>> tightened = controller.step(relative_error)  # after each epoch

    Source: the forcing term of inexact Newton methods (Eisenstat and Walker, SIAM J. Sci. Comput. 17, 1996)
    and of optimisation with approximate gradients (Pedregosa, ICML 2016).
    """

    def __init__(
        self,
        steppers: Steppers = (),
        *,
        process_group: "ProcessGroup | None" = None,
        **settings: Unpack[ToleranceSettings],
    ) -> None:
        super().__init__(**_checked("ToleranceController", settings, _C.TOLERANCE_DEFAULTS))
        self._take(steppers, process_group)

    @between_graphs
    def step(self, error: Number, converged: bool | None = None) -> bool:
        """Decide after an interval. Returns True if rtol became smaller.

        `warning` looks at `info` of the steppers' last solves: validate with steps of their own.

        Args:
            error: the relative error of what is trained; finite, >= 0. For a network this is
                ‖u - u_ref‖ / ‖u_ref‖ on validation data after one step, the square root of a normalised squared
                metric. Divide an error after n steps by n, since errors add up. In an inverse problem it is the
                relative misfit, ‖simulated - observed‖ / ‖observed‖.
            converged: ignored; `PRDPController` takes it.
        """
        return self._decide(_number("ToleranceController", "error", error), converged, None)

    @property
    def history(self) -> list[ToleranceRecord]:
        """Every call of `step` as a `ToleranceRecord`."""
        return self._recorded(self._record)

    def _record(self, row: Row, before: ToleranceRecord | None) -> ToleranceRecord:
        error, smallest, _, tightened, _, residual = row
        earlier = math.inf if before is None else before.smallest
        return ToleranceRecord(error, smallest, self._rtol_for(earlier), tightened, residual)

    def __repr__(self) -> str:
        settings = ", ".join(f"{name}={value:g}" for name, value in self.settings.items())
        return f"ToleranceController(rtol={self.rtol:.1e}, adjoint_rtol={self.adjoint_rtol:.1e}; {settings})"


class LinearSchedule(_C.LinearSchedule, _Attached):
    """A manual schedule: K = initial + increment·(calls of step), at most `maximum`. increment = 0 keeps K constant.

    Its `step`, `state_dict` and `warning` are those of `PRDPController`; it ignores the metric and keeps no history.
    `adjoint_ratio` and `process_group` have the same meaning.

    Raises:
        ValueError, TypeError: a setting is out of range or of a wrong type.

    Examples:
        >>> schedule = prdp.LinearSchedule([heat], initial=2, increment=1, maximum=20)
        >>> schedule.step(0.0)  # after each epoch
    """

    def __init__(
        self,
        steppers: Steppers = (),
        *,
        initial: int,
        increment: int,
        maximum: int,
        adjoint_ratio: float | None = None,
        process_group: "ProcessGroup | None" = None,
    ) -> None:
        settings = {"initial": initial, "increment": increment, "maximum": maximum}
        settings = {name: _check.whole("LinearSchedule", name, value) for name, value in settings.items()}
        adjoint_ratio = _check.optional(_check.real, "LinearSchedule", "adjoint_ratio", adjoint_ratio)
        super().__init__(**settings, adjoint_ratio=adjoint_ratio)
        self._take(steppers, process_group)

    @between_graphs
    def step(self, metric: Number = 0.0, converged: bool | None = None, error: Number | None = None) -> bool:
        """Advance the schedule. Returns True if K was raised."""
        error = None if error is None else _number("LinearSchedule", "error", error)
        return self._decide(_number("LinearSchedule", "metric", metric), converged, error)

    def __repr__(self) -> str:
        settings = ", ".join(f"{name}={value}" for name, value in self.settings.items() if value is not None)
        return f"LinearSchedule(max_iter={self.max_iter}; {settings})"
