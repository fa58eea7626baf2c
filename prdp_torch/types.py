"""The types of arguments that several functions and classes take, for annotations of your own."""

from collections.abc import Iterable, Sequence
from typing import Literal, Protocol, TypeAlias, TypedDict

from torch import Tensor

Backward: TypeAlias = Literal["implicit", "unrolled", "none"]
"""How the gradient of a solve is computed."""

OnFailure: TypeAlias = Literal["raise", "warn", "return", "zero_grad"]
"""What happens if a sample fails."""

Start: TypeAlias = Literal["zero", "state"]
"""Where the solves of a step start."""

CheckpointEvery: TypeAlias = int | Literal["sqrt"] | None
"""Which iterates an unrolled solve stores."""

Shape: TypeAlias = Sequence[int]
"""The unknowns along each axis, a tuple or a list such as (30,)."""

Length: TypeAlias = float | Sequence[float]
"""The side of the domain, one number or one per axis."""

Number: TypeAlias = float | Tensor
"""A number, or a tensor with a single element."""

NullSpace: TypeAlias = Literal["constant"] | Tensor | None
"""What an operator maps to zero: the constant, or vectors (k, *shape) or (k, channels, *shape)."""

Report: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""What the compiled library reports of a solve, in the order of `SolveInfo`."""

Solution: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""What it returns: u, and the report."""


class StepOptions(TypedDict, total=False):
    """The options that every stepper takes by keyword."""

    adjoint_max_iter: int | None
    adjoint_rtol: float | None
    on_failure: OnFailure
    checkpoint_every: CheckpointEvery
    start: Start


class Refinable(Protocol):
    """What a controller refines: a stepper, or anything else with a `max_iter`, which may be a property whose setter
    turns several knobs. A `ToleranceController` also sets `rtol`, `adjoint_rtol` and `adjoint_max_iter`. A controller
    reads `converged` where it is a bool, and `info` where it has the tensors of a `SolveInfo`."""

    @property
    def max_iter(self) -> int: ...

    @max_iter.setter
    def max_iter(self, k: int) -> None: ...


Steppers: TypeAlias = Iterable[Refinable]
"""The steppers of a controller."""
