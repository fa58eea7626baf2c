"""Controllers: how many iterations K the solver gets, from one training interval to the next."""

from collections.abc import Iterable
from typing import NamedTuple

import torch

from prdp_torch import _C, _check


class Record(NamedTuple):
    """One call of `PRDPController.step`."""

    metric: float
    smoothed: float
    """Exponentially weighted mean L̃ of the metrics so far."""
    max_iter: int
    """K before the decision."""
    refined: bool


class _Attached:
    """Hands K on to the steppers; can be copied and pickled, with the steppers."""

    _native: type
    """The compiled class."""

    def __getstate__(self):
        return {"settings": self.settings, "state": self.state_dict(), "attributes": self.__dict__}

    def __setstate__(self, saved):
        self._native.__init__(self, **saved["settings"])
        self._load(**saved["state"])
        self.__dict__.update(saved["attributes"])

    def _take(self, steppers):
        who = type(self).__name__
        if not isinstance(steppers, Iterable):
            raise TypeError(f"{who}: steppers must be a list such as [heat], got {steppers!r}")
        self.steppers = list(steppers)
        for stepper in self.steppers:
            if not hasattr(stepper, "max_iter"):
                raise TypeError(f"{who}: a stepper must have max_iter, got {stepper!r}")

    def _push(self):
        for stepper in self.steppers:
            stepper.max_iter = self.max_iter

    def _solves_converge(self):
        return bool(self.steppers) and all(getattr(s, "converged", False) for s in self.steppers)

    def load_state_dict(self, state):
        """Continue exactly where `state_dict()` was taken. ValueError for anything else."""
        wanted = self.state_dict().keys()
        if not isinstance(state, dict) or state.keys() != wanted:
            raise ValueError(f"{type(self).__name__}: expected a state of {', '.join(wanted)}, got {state!r:.80}")
        self._load(**state)
        self._push()


def _number(who, metric):
    """A metric as a float; a tensor of one element is one."""
    if isinstance(metric, torch.Tensor) and metric.numel() == 1:
        return metric.item()
    return _check.real(who, "metric", metric)


def _checked(who, settings, defaults):
    """The settings over the defaults; a setting is a real number where its default is one."""
    for name, value in settings.items():
        if name not in defaults:
            raise TypeError(f"{who}: unknown setting '{name}'; allowed: {', '.join(defaults)}")
        check = _check.real if isinstance(defaults[name], float) else _check.whole
        if value is not defaults[name]:
            check(who, name, value)
    return {**defaults, **settings}


class PRDPController(_C.PRDPController, _Attached):
    """Progressively Refined Differentiable Physics: raise K when the metric stops improving, until
    raising it no longer pays (paper, section 3).

    Args:
        steppers: whose `max_iter` follows K: set to `initial` now, raised with K later; may be empty,
            then read `.max_iter`.
        tau_step: τ_step, plateau where L̃[-1]/L̃[-δ] > tau_step.
        tau_stop: τ_stop, refine on a plateau where L̃[-1] < tau_stop · (L̃ at the last refinement), or
            where the metric has grown since.
        delta: δ >= 2, how many values back the plateau is judged.
        window: of the exponential mean L̃, α = 2/(window + 1); 1 smooths nothing.
        initial, increment, maximum: K₀, ΔK, and a bound (None: none).
        growth: refine to K ← growth·K where that is more than K + increment.

    K stays where every solve of the attached steppers already meets its tolerance.
    Raises ValueError for a setting or a metric out of range, TypeError for one of a wrong type.
    """

    _native = _C.PRDPController

    def __init__(self, steppers=(), **settings):
        super().__init__(**_checked("PRDPController", settings, _C.PRDP_DEFAULTS))
        self._take(steppers)
        self._push()

    def step(self, metric, converged=None):
        """Take the metric (finite, >= 0; smaller is better) of an interval. True if K was raised.

        converged: that the solves meet their tolerance; asked of the steppers where None.
        """
        converged = self._solves_converge() if converged is None else converged
        refined = self._step(_number("PRDPController", metric), bool(converged))
        self._push()
        return refined

    @property
    def history(self):
        """Every call of `step` as a `Record`."""
        return [Record(*row) for row in self._history]

    def state_dict(self):
        return {"max_iter": self.max_iter, "checkpoint": self._checkpoint, "history": self._history}

    def __repr__(self):
        settings = ", ".join(f"{name}={value:g}" for name, value in self.settings.items() if value is not None)
        smoothed = f"{self.history[-1].smoothed:.3e}" if self._history else "none yet"
        return f"PRDPController(max_iter={self.max_iter}, smoothed metric {smoothed}; {settings})"


class LinearSchedule(_C.LinearSchedule, _Attached):
    """The manual schedule: K = initial + increment·(calls of step), at most `maximum`; increment = 0
    is a constant K. The same interface as `PRDPController`; the metric is not looked at."""

    _native = _C.LinearSchedule

    def __init__(self, steppers=(), *, initial, increment, maximum):
        settings = {"initial": initial, "increment": increment, "maximum": maximum}
        super().__init__(**{name: _check.whole("LinearSchedule", name, value) for name, value in settings.items()})
        self._take(steppers)
        self._push()

    def step(self, metric=0.0, converged=None):
        """Go one step of the schedule. True if K was raised."""
        raised = self._step(_number("LinearSchedule", metric), bool(converged))
        self._push()
        return raised

    def state_dict(self):
        return {"max_iter": self.max_iter}

    def __repr__(self):
        settings = ", ".join(f"{name}={value}" for name, value in self.settings.items())
        return f"LinearSchedule(max_iter={self.max_iter}; {settings})"
