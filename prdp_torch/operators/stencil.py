"""Coefficients at every point of a grid."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

from torch import Tensor

from prdp_torch import _check
from prdp_torch.operators.base import Operator, null_spaces_of
from prdp_torch.types import NullSpace

Boundary: TypeAlias = Literal["zero", "periodic"]


class Stencil(Operator):
    """An operator of your own on a grid of 1 to 3 axes, given by its coefficients at every point. It is the same for
    every channel of v:

        (A v)[i] = Σ_k coefficients[k, i] · v[i + offsets[k]]

    It has everything that the built-in operators have: CPU loops, every solver except `Chebyshev`, and both kinds of
    gradients. It is fastest if `offsets` are nearest neighbours, such as
    [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)] in two dimensions.

    Args:
        coefficients: (batch, k, *shape), or (1, k, *shape) for all samples alike; float32 or float64, as the
            vectors (batch, channel, *shape). They get gradients. Where a neighbour lies outside the grid its
            coefficient has no influence, but it must be finite. Take float64 where the sum of a row is small beside
            its diagonal, as for fourth derivatives on fine grids: float32 rounds it, and steps lose the mean of u.
        offsets: k tuples of whole numbers, one entry for each axis of shape, at most two cells along each.
        boundary: "zero" (v is 0 outside the grid) or "periodic", one for all axes or one for each.
        nullspace: what A maps to zero, where it is singular: "constant" (in each channel), vectors (k, *shape) for each
            channel, vectors (k, channels, *shape) of all channels together, or these for each sample, (batch, k,
            channels, *shape), with zeros where a sample has fewer. Then b, u and cotangents are taken without their
            part there, and a b that has one beyond rtol is INCONSISTENT. Vectors may depend on parameters: the
            gradients are those of the pseudo-inverse.
        left_nullspace: what Aᵀ maps to zero, as many vectors. None takes those of nullspace, as for symmetric A.

    Raises:
        ValueError, TypeError: the arguments do not fit together. This is checked before any work.

    Examples:
        >>> A = operators.Stencil(torch.stack([1 + a + b, -a, -b], 1), [(0,), (-1,), (1,)], boundary="periodic")
    """

    kind = "stencil"
    offsets: list[tuple[int, ...]]
    boundary: tuple[Boundary, ...]

    def __init__(
        self,
        coefficients: Tensor,
        offsets: Sequence[Sequence[int]],
        boundary: Boundary | Sequence[Boundary] = "zero",
        nullspace: NullSpace = None,
        left_nullspace: NullSpace = None,
    ) -> None:
        dim = _check.dense("Stencil", "coefficients", coefficients).dim() - 2
        if not 1 <= dim <= 3:
            raise ValueError(
                "Stencil: coefficients must have shape (batch or 1, k, *shape) with 1 to 3 axes in shape, got "
                f"{tuple(coefficients.shape)}"
            )
        self.offsets = _offsets(offsets, tuple(coefficients.shape))
        several = tuple(boundary) if isinstance(boundary, tuple | list) else ()
        self.boundary = (boundary,) * dim if isinstance(boundary, str) else several
        if len(self.boundary) != dim or not set(self.boundary) <= {"zero", "periodic"}:
            raise ValueError(
                f"Stencil: boundary must be 'zero' or 'periodic', one for all axes or one for each of {dim}, "
                f"got {boundary!r}"
            )
        periodic = [float(b == "periodic") for b in self.boundary]
        cells = [float(n) for offset in self.offsets for n in offset]
        null_spaces = null_spaces_of("Stencil", nullspace, left_nullspace, coefficients)
        super().__init__(list(coefficients.shape[2:]), periodic + cells, {"coefficients": coefficients}, null_spaces)

    def _settings(self) -> dict[str, object]:
        return {"offsets": self.offsets, "boundary": self.boundary}


def _offsets(offsets: Sequence[Sequence[int]], coefficients: tuple[int, ...]) -> list[tuple[int, ...]]:
    """As a list of tuples of whole numbers, one for each axis of the grid."""
    dim = len(coefficients) - 2
    if not isinstance(offsets, (tuple, list)) or not all(isinstance(o, (tuple, list)) for o in offsets):
        raise TypeError(
            f"Stencil: offsets must be a list of tuples such as [(0, 0), (0, -1)], got {_check.shown(offsets)}"
        )
    for offset in offsets:
        if len(offset) != dim:
            entries = "1 entry" if dim == 1 else f"{dim} entries"
            raise ValueError(
                f"Stencil: every offset must have {entries}, one for each axis of shape, got {tuple(offset)}; "
                f"coefficients {coefficients} are (batch or 1, k, *shape), so shape is {coefficients[2:]}"
            )
    return [tuple(_check.whole("Stencil", "every entry of an offset", n) for n in offset) for offset in offsets]
