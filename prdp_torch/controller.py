"""Controllers: how far the solver goes, from one training interval to the next."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch

from prdp_torch import _C, _check, processes


class Record(NamedTuple):
    """One call of `step` of a `PRDPController`."""

    metric: float
    smoothed: float
    """Exponentially weighted mean L̃ of the metrics so far."""
    max_iter: int
    """K before the decision."""
    refined: bool
    error: float | None = None
    """The relative error that `step` was given."""
    residual: float | None = None
    """‖b - A u‖ / ‖b‖ where the attached solves ended, the mean over the samples."""


class ToleranceRecord(NamedTuple):
    """One call of `step` of a `ToleranceController`."""

    error: float
    smallest: float
    """The smallest error so far."""
    rtol: float
    """Before the decision."""
    tightened: bool
    residual: float | None = None
    """As of a `Record`."""


class _Attached:
    """What controllers share: they hand K and tolerances on to the steppers, and ask them how the solves went."""

    def _take(self, steppers, process_group):
        who = type(self).__name__
        if process_group is not None and processes.rank(who, process_group) < 0:
            raise ValueError(f"{who}: this process does not belong to process_group")
        self.process_group = process_group
        if not isinstance(steppers, Iterable):
            raise TypeError(f"{who}: steppers must be a list such as [heat], got {steppers!r}")
        self.steppers = list(steppers)
        for stepper in self.steppers:
            for name, value in self._budget.items():
                if value is not None and not hasattr(stepper, name):
                    raise TypeError(f"{who}: a stepper must have {name}, got {stepper!r}")
        self._push()

    def _push(self):
        budget = {name: value for name, value in self._budget.items() if value is not None}
        for stepper in self.steppers:
            for name, value in budget.items():
                setattr(stepper, name, value)

    def _decide(self, metric, converged, error):
        """One step of the compiled controller, and what follows from it for the steppers."""
        if converged is None:
            converged = bool(self.steppers) and all(getattr(s, "converged", False) for s in self.steppers)
        refined = self._step(*self._of_all_processes(metric, bool(converged), error))
        self._push()
        return refined

    def _of_all_processes(self, metric, converged, error):
        """(metric, converged, residual, error), the same in every process: means, and whether all have converged. The
        residual is that where the last solves ended: the mean over the samples, of several steppers the largest."""
        ended = [getattr(stepper, "info", None) for stepper in self.steppers]
        residuals = [torch.zeros(0) if info is None else info.residual.double() for info in ended]
        many = processes.count(self.process_group)
        if many > 1:
            # One that is refused must be refused in every process.
            numbers = [math.nan if x < 0 else x for x in (metric, 0.0 if error is None else error)]
            numbers += [converged, error is not None]
            metric, error_sum, agree, known, *of_steppers = processes.sums(
                [*numbers, *(n for r in residuals for n in (r.sum(), r.numel()))], self.process_group
            )
            metric, converged, error = metric / many, agree == many, error_sum / many if known == many else None
            means = [total / n for total, n in zip(of_steppers[::2], of_steppers[1::2], strict=True) if n]
        else:
            means = [float(r.mean()) for r in residuals if r.numel()]
        return metric, converged, max((r for r in means if math.isfinite(r)), default=None), error

    def state_dict(self):
        """What `load_state_dict` needs to continue exactly, as plain values."""
        return {"max_iter": self.max_iter, "checkpoint": self._checkpoint, "history": self._history}

    def load_state_dict(self, state):
        """Continue exactly where `state_dict()` was taken. ValueError for anything else."""
        wanted = self.state_dict().keys()
        if not isinstance(state, dict) or state.keys() != wanted:
            raise ValueError(f"{type(self).__name__}: expected a state of {', '.join(wanted)}, got {state!r:.80}")
        self._load(**state)
        self._push()

    def __reduce__(self):
        if self.process_group is not None:
            raise TypeError(f"{type(self).__name__}: only a controller of the default process group can be copied")
        return _remade, (type(self), self.steppers, self.settings, self.state_dict())


def _remade(kind, steppers, settings, state):
    """A copy of a controller."""
    controller = kind(steppers, **settings)
    controller.load_state_dict(state)
    return controller


def _number(who, name, value):
    """A metric as a float; a tensor of one element is one."""
    if isinstance(value, torch.Tensor) and value.numel() == 1:
        return value.item()
    return _check.real(who, name, value)


def _checked(who, settings, defaults):
    """The settings over the defaults, each of its default's type; a maximum or ratio may be None where its
    default is."""
    whole = {"delta", "window", "initial", "increment", "maximum"}
    for name, value in settings.items():
        if name not in defaults:
            raise TypeError(f"{who}: unknown setting '{name}'; allowed: {', '.join(defaults)}")
        check = _check.whole if name in whole else _check.real
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
        adjoint_ratio: the adjoint solve gets ⌈adjoint_ratio·K⌉ iterations; None: what the stepper says.
        process_group: of torch.distributed; None: the default one. Where that is initialised, `step` is a collective
            call: every process calls it with the metric of its own samples, and all of them see the mean, so that
            they refine in the same interval. No effect on a single process.

    K stays where every solve of the attached steppers already meets its tolerance.
    `warning`, of every controller: None, or in words what is wrong if the training ends here, with solves
    that stop so far from the solution that their own error makes up what is trained.
    Raises ValueError for a setting or a metric out of range, TypeError for one of a wrong type.
    """

    def __init__(self, steppers=(), *, process_group=None, **settings):
        super().__init__(**_checked("PRDPController", settings, _C.PRDP_DEFAULTS))
        self._take(steppers, process_group)

    def step(self, metric, converged=None, error=None):
        """Take the metric (finite, >= 0; smaller is better) of an interval. True if K was raised.

        converged: that the solves meet their tolerance; asked of the steppers where None.
        error: the relative error of what is trained, as `ToleranceController.step` takes it, where you
            know it. `warning` compares it with the residual of the solves.
        """
        error = None if error is None else _number("PRDPController", "error", error)
        return self._decide(_number("PRDPController", "metric", metric), converged, error)

    @property
    def history(self):
        """Every call of `step` as a `Record`."""
        return [Record(*row) for row in self._history]

    def __repr__(self):
        settings = ", ".join(f"{name}={value:g}" for name, value in self.settings.items() if value is not None)
        smoothed = f"{self.history[-1].smoothed:.3e}" if self._history else "none yet"
        return f"PRDPController(max_iter={self.max_iter}, smoothed metric {smoothed}; {settings})"


class ToleranceController(_C.ToleranceController, _Attached):
    """Tie the tolerance of the solves to the error of what is trained: nothing to tune, no K to choose.

    While a network is wrong by a fifth, a solve that is right to a fiftieth serves it; as the error falls,
    the solves follow. Take this one unless you have tuned `PRDPController` for your problem
    (docs/refinement.md compares them).

    Args:
        steppers: their `rtol`, `adjoint_rtol`, `max_iter` and `adjoint_max_iter` are set now and after
            every step; may be empty, then read `.rtol`, `.adjoint_rtol` and `.max_iter`.
        ratio: rtol = ratio · min(1, smallest relative error so far), in (0, 1).
        adjoint_ratio: the adjoint solve's rtol is rtol / adjoint_ratio, at most 1/2, and its K is
            ⌈adjoint_ratio·K⌉; in (0, 1].
        floor: no rtol is smaller; > 0. In float32 about 1e-5 is what can be reached.
        maximum: K, a cap that a solve should never meet; >= 1.
        process_group: as for `PRDPController`; the error is averaged over its processes.

    Under `torch.compile` a step compiles again for each new rtol, and goes on uncompiled after
    `torch._dynamo.config.recompile_limit` of them (8): raise it, or leave this step uncompiled.

    Raises ValueError for a setting or an error out of range, TypeError for one of a wrong type.

        heat = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=1))
        controller = prdp.ToleranceController([heat])
        # after each epoch: controller.step(relative_error)

    Source: the forcing term of inexact Newton methods (Eisenstat and Walker, SIAM J. Sci. Comput. 17, 1996)
    and of optimisation with approximate gradients (Pedregosa, ICML 2016).
    """

    def __init__(self, steppers=(), *, process_group=None, **settings):
        super().__init__(**_checked("ToleranceController", settings, _C.TOLERANCE_DEFAULTS))
        self._take(steppers, process_group)

    def step(self, error, converged=None):
        """Take the relative error of what is trained (finite, >= 0) after an interval. True if rtol became
        smaller.

        error: ‖u - u_ref‖ / ‖u_ref‖ on validation data after one step, which is the square root of a
            normalised squared metric. Of an error after n steps take the n-th part, since errors add up. In
            an inverse problem the relative misfit, ‖simulated - observed‖ / ‖observed‖.
        converged: not looked at; for the interface of `PRDPController`.
        """
        return self._decide(_number("ToleranceController", "error", error), converged, None)

    @property
    def history(self):
        """Every call of `step` as a `ToleranceRecord`."""
        before = [math.inf, *(smallest for _, smallest, *_ in self._history)]
        return [
            ToleranceRecord(error, smallest, self._rtol_for(earlier), tightened, residual)
            for earlier, (error, smallest, _, tightened, _, residual) in zip(before, self._history, strict=False)
        ]

    def __repr__(self):
        settings = ", ".join(f"{name}={value:g}" for name, value in self.settings.items())
        return f"ToleranceController(rtol={self.rtol:.1e}, adjoint_rtol={self.adjoint_rtol:.1e}; {settings})"


class LinearSchedule(_C.LinearSchedule, _Attached):
    """The manual schedule: K = initial + increment·(calls of step), at most `maximum`; increment = 0
    is a constant K. The same interface as `PRDPController`; the metric is not looked at. `adjoint_ratio` and
    `process_group` as there."""

    def __init__(self, steppers=(), *, initial, increment, maximum, adjoint_ratio=None, process_group=None):
        settings = {"initial": initial, "increment": increment, "maximum": maximum}
        settings = {name: _check.whole("LinearSchedule", name, value) for name, value in settings.items()}
        adjoint_ratio = _check.optional(_check.real, "LinearSchedule", "adjoint_ratio", adjoint_ratio)
        super().__init__(**settings, adjoint_ratio=adjoint_ratio)
        self._take(steppers, process_group)

    def step(self, metric=0.0, converged=None, error=None):
        """Go one step of the schedule. True if K was raised."""
        error = None if error is None else _number("LinearSchedule", "error", error)
        return self._decide(_number("LinearSchedule", "metric", metric), converged, error)

    def __repr__(self):
        settings = ", ".join(f"{name}={value}" for name, value in self.settings.items() if value is not None)
        return f"LinearSchedule(max_iter={self.max_iter}; {settings})"
