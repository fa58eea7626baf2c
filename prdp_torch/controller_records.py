"""What controllers take as settings, and what they record of each call of `step`."""

from typing import NamedTuple, TypedDict


class Record(NamedTuple):
    """One call of `step` of a `PRDPController`."""

    metric: float
    """What `step` was given."""
    smoothed: float
    """Exponentially weighted mean L̃ of the metrics so far."""
    max_iter: int
    """K before the decision."""
    refined: bool
    """Whether K was raised."""
    error: float | None = None
    """The relative error that `step` was given."""
    residual: float | None = None
    """‖b - A u‖ / ‖b‖ where the attached solves ended, the mean over the samples."""


class PRDPSettings(TypedDict, total=False):
    """The settings of a `PRDPController`."""

    tau_step: float
    tau_stop: float
    delta: int
    window: int
    initial: int
    increment: int
    maximum: int | None
    growth: float
    adjoint_ratio: float | None


class ToleranceSettings(TypedDict, total=False):
    """The settings of a `ToleranceController`."""

    ratio: float
    adjoint_ratio: float
    floor: float
    adjoint_floor: float
    maximum: int


class ToleranceRecord(NamedTuple):
    """One call of `step` of a `ToleranceController`."""

    error: float
    """What `step` was given."""
    smallest: float
    """The smallest error so far."""
    rtol: float
    """Before the decision."""
    tightened: bool
    """Whether rtol became smaller."""
    residual: float | None = None
    """As of a `Record`."""
