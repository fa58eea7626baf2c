"""How a training chooses K and the tolerance."""

from collections.abc import Callable, Sequence
from typing import Self, TypeAlias

from prdp_torch.controller import LinearSchedule, PRDPController, ToleranceController
from prdp_torch.experiments import _C
from prdp_torch.flow import Flow
from prdp_torch.stepper import Stepper

Controller: TypeAlias = LinearSchedule | PRDPController | ToleranceController


def start_from_states(steppers: Sequence[Stepper]) -> None:
    """Let the solves start from the state before the step. Those of a `Flow` are for changes, and start from zero."""
    for stepper in steppers:
        if not isinstance(stepper, Flow):
            stepper.start = "state"


class Refinement:
    """How a training chooses K and the tolerance. Use one of the class methods below.

    Args:
        label: name of the folder of the records.
        attach: a function that takes the steppers and returns their controller.
        direct: whether the exact solver replaces that of the scene.
        watches_error: whether the controller's `step` takes the relative error instead of the metric.
    """

    def __init__(
        self,
        label: str,
        attach: Callable[[Sequence[Stepper]], Controller],
        direct: bool = False,
        watches_error: bool = False,
    ) -> None:
        self.label = label
        self.attach = attach
        self.direct = direct
        self.watches_error = watches_error

    @classmethod
    def auto(cls) -> Self:
        """A tolerance that follows the error (`ToleranceController`), and starts from the state: nothing to choose."""

        def attach(steppers: Sequence[Stepper]) -> ToleranceController:
            start_from_states(steppers)
            return ToleranceController(steppers)

        return cls("auto", attach, watches_error=True)

    @classmethod
    def prdp(cls, scene: _C.Scene, growth: float | None = None) -> Self:
        """PRDP with the settings of the scene, or with another `growth` (`PRDPController`)."""
        settings = dict(scene.prdp)
        if growth is not None:
            settings["growth"] = growth
        label = "prdp" if growth is None else f"prdp_growth_{growth:g}"
        return cls(label, lambda steppers: PRDPController(steppers, **settings))

    @classmethod
    def constant(cls, k: int) -> Self:
        """The same K throughout."""
        return cls.schedule(k, 0, k, label=f"constant_{k}")

    @classmethod
    def tolerance(cls, rtol: float, k: int) -> Self:
        """The same tolerance rtol throughout, with at most k iterations."""

        def attach(steppers: Sequence[Stepper]) -> LinearSchedule:
            for stepper in steppers:
                stepper.rtol = rtol
            return LinearSchedule(steppers, initial=k, increment=0, maximum=k)

        return cls(f"rtol_{rtol:g}", attach)

    @classmethod
    def schedule(cls, start: int, step: int, maximum: int, label: str | None = None) -> Self:
        """K starts at `start` and grows by `step` after each interval, up to `maximum`."""
        return cls(
            label or f"schedule_{start}_{step}",
            lambda steppers: LinearSchedule(steppers, initial=start, increment=step, maximum=maximum),
        )

    @classmethod
    def exact(cls) -> Self:
        """The exact solver."""
        return cls("direct", lambda steppers: LinearSchedule(steppers, initial=1, increment=0, maximum=1), direct=True)
