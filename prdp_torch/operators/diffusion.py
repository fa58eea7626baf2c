"""Diffusion by finite volumes."""

import numbers
from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

import torch
from torch import Tensor

from prdp_torch import _check
from prdp_torch.operators.base import Operator, full_precision
from prdp_torch.types import Length, Number

Side: TypeAlias = Literal["zero", "flux", "periodic"] | tuple[Literal["robin"], Number]
Sides: TypeAlias = Side | Sequence[Side | tuple[Side, Side] | list[Side]]
"""One for all sides, one for each axis, or a pair (low, high) for each axis."""

OfSides: TypeAlias = Number | Sequence[Sequence[Number | None]]
"""One for all sides, or a pair (low, high) for each axis."""

KINDS = ("zero", "flux", "periodic", "robin")  # by the numbers that the compiled library gives them
TAKE_VALUES = ("zero", "robin")
ENDS = ("low", "high")


class Diffusion(Operator):
    """Diffusion on the cells of a box by finite volumes: A u = shift·u - ∇·(κ ∇u), the same for every channel of u.

    It is symmetric. Where neither a side nor the shift holds u, A is singular; the constant is then its `nullspace`
    (see `Stencil`). That is told by numbers: a sample in which tensors of zeros stand for shift and h is refused.
    Values and fluxes at the sides that are not zero belong to b: `boundary_rhs` makes that part.

    Args:
        kappa: (batch, *shape), or (1, *shape) for all samples alike, κ > 0 in the centres of the cells; shape has 1 to
            3 axes. With per_axis (batch or 1, axes, *shape). Gets a gradient, which is formed from fluxes: in float32
            it keeps digits that the gradient of a `Stencil`'s coefficients loses.
        shift: a number, or a tensor, which gets a gradient: a field (batch or 1, *shape), or a number for each sample,
            (batch, 1) in 1D, (batch, 1, 1) in 2D. With 1/dt, A is a step of ∂u/∂t = ∇·(κ ∇u) by implicit Euler, with
            b = u/dt. In float32 products are made of fluxes: for `CG` and `Direct` a small shift, weak sides and jumps
            of κ are not lost in the rounding of a diagonal, though the residual may end at ε max κ Σ 2/dx² |u|, with a
            warning. `Direct` ends with BREAKDOWN where its factors lose what holds u, from κ/dx² = 1e13 times that on.
            `MINRES` and `GMRES`, which go by the residual, and the coarse grids of multigrid do lose what holds u by
            less than that.
        boundary: "zero" (u = 0 on the side, half a cell from the nearest centre), "flux" (none passes), "periodic", or
            ("robin", h) with h >= 0 (what flows out, -κ ∂u/∂n with the normal n pointing outwards, is h u on the side):
            one for all sides, one for each axis, or a pair (low, high) for each axis. h is a number, or a tensor
            (batch or 1, *side) where side is shape without the axis, and gets a gradient.
        length: the side of the box, one number or one for each axis in the order of `shape`.
        faces: how κ on a face is made of its two cells: "harmonic", which is exact for layers, or "arithmetic".
        per_axis: whether κ differs between the axes, as in layered ground: A u = shift·u - Σ_d ∂(κ_d ∂u/∂x_d)/∂x_d.
            kappa[:, d] then is κ along the axis d of shape.

    Raises:
        ValueError, TypeError: the arguments do not fit together. This is checked before any work.

    Examples:
        >>> A = prdp.operators.Diffusion(torch.rand(1, 64, 64) + 0.1, boundary=["zero", "flux"])
        >>> u, info = prdp.linear_solve(A, torch.ones(1, 1, 64, 64), prdp.CG(20, preconditioner="multigrid"))
    """

    kind = "diffusion"
    per_axis: bool
    boundary: list[tuple[str, ...]]
    length: tuple[float, ...]

    def __init__(
        self,
        kappa: Tensor,
        shift: Number = 0.0,
        boundary: Sides = "zero",
        length: Length = 1.0,
        faces: Literal["harmonic", "arithmetic"] = "harmonic",
        per_axis: bool = False,
    ) -> None:
        dim = _check.dense("Diffusion", "kappa", kappa).dim() - (2 if per_axis else 1)
        if not 1 <= dim <= 3 or (per_axis and kappa.shape[1] != dim):
            raise ValueError(
                f"Diffusion: kappa must have shape (batch or 1, {'axes, ' if per_axis else ''}*shape) with 1 to 3 axes "
                f"in shape, got {tuple(kappa.shape)}"
            )
        self.per_axis, shape = per_axis, kappa.shape[-dim:]
        if 0 in shape:
            raise ValueError(f"Diffusion: every extent of shape must be >= 1, got {tuple(shape)}")
        if per_axis:
            self.kind = "diffusion_per_axis"
        if faces not in ("harmonic", "arithmetic"):
            raise ValueError(f"Diffusion: faces must be 'harmonic' or 'arithmetic', got {faces!r}")
        sides = _sides(boundary, dim)
        self.boundary = [tuple(_kind(side) for side in pair) for pair in sides]
        self.length = tuple(_check.lengths("Diffusion", length, dim)) or (1.0,) * dim
        if isinstance(shift, Tensor) and shift.dim() > 0:
            if shift.shape[1:] == (1,) * dim:
                shift = shift.expand(-1, *shape)
            if shift.shape[1:] != shape:
                raise ValueError(
                    f"Diffusion: shift must be a number, one for each sample {('batch', *(1,) * dim)}, or a field "
                    f"{('batch or 1', *shape)}, got {tuple(shift.shape)}".replace("'", "")
                )
        given: dict[str, Number] = {"kappa": kappa, "shift": shift}
        for axis, pair in enumerate(sides):
            for end, side in zip(ENDS, pair, strict=True):
                if _kind(side) == "robin":
                    given[f"robin_{axis}_{end}"] = side[1]
        holds = [value for name, value in given.items() if name != "kappa"]
        is_held = any("zero" in pair for pair in self.boundary) or any(map(_is_given, holds))
        codes = [float(KINDS.index(side)) for pair in self.boundary for side in pair]
        parameters = [*codes, *self.length, float(faces == "arithmetic")]
        null_spaces = () if is_held else (kappa.new_empty(0).detach(),) * 2
        super().__init__(list(shape), parameters, given, null_spaces)

    def _settings(self) -> dict[str, object]:
        faces = "arithmetic" if self.parameters[-1] else "harmonic"
        return {"boundary": self.boundary, "length": self.length, "faces": repr(faces)}

    @property
    def kappa(self) -> Tensor:
        """κ as it was given."""
        return self.tensors[0]

    def boundary_rhs(self, values: OfSides = 0.0, fluxes: OfSides = 0.0) -> Tensor:
        """The part of b that given values and fluxes at the sides make, (batch or 1, 1, *shape), with gradients.

        Where all values lie far from zero beside their differences, such as 300 K for a rise of 1 K, solve for u minus
        one of them: rtol is relative to b, which holds the whole value, and so is the rounding of float32.

        Args:
            values: u on the sides that are "zero", and u_ext of those that are "robin", where -κ ∂u/∂n is then
                h (u - u_ext).
            fluxes: what flows in, κ ∂u/∂n with the normal n pointing outwards, on the sides that are "flux".
                Each is a pair (low, high) for each axis, or one that stands on all sides that take it; a number, or a
                tensor that broadcasts to (batch or 1, *side), where side is shape without the axis. In a pair, None is
                0.

        Raises:
            ValueError: a value that is not 0 stands at a side that takes none.
        """
        values, fluxes = self._of_sides("values", values, TAKE_VALUES), self._of_sides("fluxes", fluxes, ("flux",))
        kappa, robin = full_precision(self.kappa), iter(self.tensors[2:])
        b = torch.zeros_like(kappa[:, 0] if self.per_axis else kappa)
        for axis, sides in enumerate(self.boundary):
            width = self.length[axis] / self.shape[axis]
            for end, side in enumerate(sides):
                if side == "periodic":
                    continue
                at_side = (kappa[:, axis] if self.per_axis else kappa).select(axis + 1, -end)
                conductance = torch.ones_like(at_side) if side == "flux" else 2 * at_side
                if side == "robin":  # in series with that of the side
                    h = width * full_precision(next(robin))
                    _check_of_side("h", h, conductance)
                    conductance = _in_series(conductance, h)
                name, given = ("fluxes", fluxes) if side == "flux" else ("values", values)
                _check_of_side(name, given[axis][end], conductance)
                added = conductance * given[axis][end] / (width if side == "flux" else width**2)
                if len(added) != len(b) and 1 not in (len(added), len(b)):
                    raise ValueError(
                        f"Diffusion: the {ENDS[end]} side of axis {axis} holds {len(added)} samples, the sides before "
                        f"it {len(b)}"
                    )
                cells = torch.arange(self.shape[axis], device=b.device)
                place = (cells == end * (self.shape[axis] - 1)).to(b.dtype)  # torch.func.linearize loses what is set
                b = b + added.unsqueeze(axis + 1) * place.view(-1, *(1,) * (len(self.shape) - axis - 1))
        return b.unsqueeze(1)

    def _of_sides(self, name: str, given: OfSides, kinds: tuple[str, ...]) -> Sequence[Sequence[Number]]:
        """A value for each side, (low, high) for each axis; only sides of these kinds take one that is not zero."""
        dim = len(self.shape)
        if isinstance(given, (int, float, Tensor)):
            pairs: Sequence[Sequence[Number]] = [(given, given)] * dim
            stray = _is_given(given) and not any(side in kinds for sides in self.boundary for side in sides)
        else:
            of_axes = isinstance(given, (tuple, list)) and len(given) == dim
            if not of_axes or any(not isinstance(pair, (tuple, list)) or len(pair) != 2 for pair in given):
                raise ValueError(
                    f"Diffusion: {name} must be a number, a tensor, or a pair (low, high) for each of {dim} axes, "
                    f"(None, None) for one without, got {given!r:.80}"
                )
            pairs = [[0.0 if value is None else value for value in pair] for pair in given]
            stray = any(
                _is_given(value) and side not in kinds
                for sides, pair in zip(self.boundary, pairs, strict=True)
                for side, value in zip(sides, pair, strict=True)
            )
        if stray:
            raise ValueError(
                f"Diffusion: {name} belong to sides that are {' or '.join(map(repr, kinds))}; the boundary is "
                f"{self.boundary}, in pairs (low, high), and {name} are {given!r:.80}"
            )
        return pairs


def _in_series(a: Tensor, b: Tensor) -> Tensor:
    """a b/(a + b) for a > 0 and b >= 0, of which autograd makes derivatives that neither cancel nor overflow."""
    b_is_smaller = b <= a
    smaller, larger = torch.where(b_is_smaller, b, a), torch.where(b_is_smaller, a, b)
    return smaller / (1 + smaller / larger)


def _kind(side: Any) -> Any:
    """The name of a side; anything else as it is."""
    return side[0] if _is_robin(side) else side


def _is_robin(side: Any) -> bool:
    """Whether this is ("robin", h), and not a pair of sides."""
    return isinstance(side, (tuple, list)) and len(side) == 2 and side[0] == "robin" and _is_number(side[1])


def _is_number(value: object) -> bool:
    return isinstance(value, Tensor) or (isinstance(value, numbers.Real) and not isinstance(value, bool))


def _sides(boundary: Any, dim: int) -> list[tuple[Any, Any]]:
    """The pair (low, high) of each axis."""

    def is_side(side: Any) -> bool:
        return isinstance(side, str) or _is_robin(side)

    def is_known(side: Any) -> bool:
        return _is_robin(side) or (side in KINDS and side != "robin")

    axes = [boundary] * dim if is_side(boundary) else boundary
    pairs = []
    if isinstance(axes, tuple | list) and all(
        is_side(of_axis) or isinstance(of_axis, tuple | list) for of_axis in axes
    ):
        pairs = [(of_axis, of_axis) if is_side(of_axis) else tuple(of_axis) for of_axis in axes]
    if len(pairs) != dim or any(len(pair) != 2 or not all(map(is_known, pair)) for pair in pairs):
        raise ValueError(
            "Diffusion: boundary must be 'zero', 'flux', 'periodic' or ('robin', h): one for all sides, or one, or a "
            f"pair (low, high), for each of {dim} axes, got {boundary!r} ('zero' is Dirichlet's, 'flux' Neumann's)"
        )
    if any([_kind(side) for side in pair].count("periodic") == 1 for pair in pairs):
        raise ValueError(f"Diffusion: boundary: both sides of an axis are periodic or none is, got {boundary!r}")
    return pairs


def _check_of_side(name: str, value: Number, side: Tensor) -> None:
    if not isinstance(value, Tensor) or value.dim() == 0:
        return
    extents = zip(reversed(value.shape), reversed(side.shape), strict=False)
    fits = [n == 1 or n == of_side for n, of_side in extents]
    if value.dim() == side.dim() and side.shape[0] == 1:
        fits[-1] = True  # the batch
    if value.dim() > side.dim() or not all(fits):
        raise ValueError(
            f"Diffusion: {name} must broadcast to (batch or 1, *side), here {tuple(side.shape)}, got "
            f"{tuple(value.shape)}"
        )


def _is_given(value: Number) -> bool:
    return isinstance(value, Tensor) or value != 0
