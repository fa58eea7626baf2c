"""The walls of a `Flow` that move along themselves."""

from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from prdp_torch import _check
from prdp_torch.operators.base import full_precision

Side: TypeAlias = tuple[int, Literal["low", "high"]]
"""An end of an axis, in the order of `shape`."""

WallVelocity: TypeAlias = Mapping[Side, Tensor | Sequence[float] | float]
"""The velocity of each wall that moves."""

# The attribute that holds the velocity of a side, in the order of the compiled library.
ENDS: tuple[Literal["low"], Literal["high"]] = ("low", "high")
NAMES: dict[Side, str] = {(axis, end): f"wall_velocity_{axis}_{end}" for axis in range(3) for end in ENDS}


def by_name(given: WallVelocity | None, dim: int) -> dict[str, Tensor | Sequence[float] | None]:
    """For the name of every side, its velocity as a tensor or as numbers, one per component; None at rest."""
    if not isinstance(given, Mapping | None):
        raise TypeError(f"Flow: wall_velocity must be a dict such as {{(0, 'high'): 1.0}}, got {given!r:.80}")
    found: dict[str, Tensor | Sequence[float] | None] = dict.fromkeys(NAMES.values())
    for side, value in (given or {}).items():
        if side not in NAMES or side[0] >= dim:
            raise ValueError(
                f"Flow: a side of wall_velocity must be (axis, 'low' or 'high') with an axis below {dim}, got {side!r}"
            )
        found[NAMES[side]] = value if isinstance(value, (Tensor, tuple, list)) else _along(side, value, dim)
    return found


def vectors(velocities: Mapping[Side, Tensor], dim: int) -> list[Tensor | None]:
    """For each side of a box, low and high along each axis, a velocity with all components."""
    found: list[Tensor | None] = []
    for side in list(NAMES)[: 2 * dim]:
        velocity = velocities.get(side)
        velocity = None if velocity is None else full_precision(velocity)
        if velocity is not None and velocity.dim() == 0 and dim == 2:
            still = torch.zeros_like(velocity)
            velocity = torch.stack((velocity, still) if side[0] == 0 else (still, velocity))
        found.append(velocity)
    return found


def _along(side: Side, value: object, dim: int) -> list[float]:
    """A number as a velocity along the wall."""
    speed = _check.real("Flow", "wall_velocity", value)
    if dim != 2:
        raise ValueError(f"Flow: a number as wall_velocity is for 2D; give one per component, ({dim},)")
    return [speed, 0.0] if side[0] == 0 else [0.0, speed]
