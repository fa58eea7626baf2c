"""Diffusion by finite volumes."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from prdp_torch import _check
from prdp_torch.operators.base import Operator, real_tensor
from prdp_torch.types import Length, Number

Side: TypeAlias = Literal["zero", "flux", "periodic"]
Sides: TypeAlias = Side | Sequence[Side | tuple[Side, Side] | list[Side]]
"""One for all sides, one for each axis, or a pair (low, high) for each axis."""

OfSides: TypeAlias = Number | Sequence[Sequence[Number]]
"""One for all sides, or a pair (low, high) for each axis."""


class Diffusion(Operator):
    """Diffusion on the cells of a box by finite volumes: A u = shift·u - ∇·(κ ∇u), the same for every channel of u.

    It is symmetric. Where neither a side nor the shift holds u, A is singular; the constant is then its `nullspace`
    (see `Stencil`). Values and fluxes at the sides that are not zero belong to b: `boundary_rhs` makes that part.

    Args:
        kappa: (batch, *shape), or (1, *shape) for all samples alike, κ > 0 in the centres of the cells; shape has 1 to
            3 axes. Gets a gradient, which is formed from fluxes: in float32 it keeps digits that the gradient of a
            `Stencil`'s coefficients loses.
        shift: a number, or a tensor like kappa, which gets a gradient. With 1/dt, A is a step of ∂u/∂t = ∇·(κ ∇u) by
            implicit Euler, with b = u/dt. In float32, A holds it to ε max κ Σ 2/dx², beside which it must not be small:
            a warning says so. Take float64 for large jumps of κ on fine grids.
        boundary: "zero" (u = 0 on the side, half a cell from the nearest centre), "flux" (none passes) or "periodic":
            one for all sides, one for each axis, or a pair (low, high) for each axis.
        length: the side of the box, one number or one for each axis in the order of `shape`.
        faces: how κ on a face is made of its two cells: "harmonic", which is exact for layers, or "arithmetic".

    Raises:
        ValueError, TypeError: the arguments do not fit together. This is checked before any work.

    Examples:
        >>> A = prdp.operators.Diffusion(torch.rand(1, 64, 64) + 0.1, boundary=["zero", "flux"])
        >>> u, info = prdp.linear_solve(A, torch.ones(1, 1, 64, 64), prdp.CG(20, preconditioner="multigrid"))
    """

    kind = "diffusion"
    boundary: list[tuple[str, ...]]
    length: tuple[float, ...]
    kappa: Tensor

    def __init__(
        self,
        kappa: Tensor,
        shift: Number = 0.0,
        boundary: Sides = "zero",
        length: Length = 1.0,
        faces: Literal["harmonic", "arithmetic"] = "harmonic",
    ) -> None:
        dim = _check.dense("Diffusion", "kappa", kappa).dim() - 1
        if not 1 <= dim <= 3:
            raise ValueError(
                "Diffusion: kappa must have shape (batch or 1, *shape) with 1 to 3 axes in shape, got "
                f"{tuple(kappa.shape)}"
            )
        if faces not in ("harmonic", "arithmetic"):
            raise ValueError(f"Diffusion: faces must be 'harmonic' or 'arithmetic', got {faces!r}")
        self.boundary = _sides(boundary, dim)
        self.length = tuple(_check.lengths("Diffusion", length, dim)) or (1.0,) * dim
        self.kappa = kappa
        if isinstance(shift, Tensor) and shift.dim() > 0:
            if shift.dim() != kappa.dim():
                raise ValueError(
                    f"Diffusion: shift must be a number or have the shape of kappa, {tuple(kappa.shape)}, got "
                    f"{tuple(shift.shape)}"
                )
            shift, is_held = shift.unsqueeze(1), True
        else:
            is_held = isinstance(shift, Tensor) or shift != 0
            shift = real_tensor("Diffusion", "shift", shift)
        is_held = is_held or any("zero" in sides for sides in self.boundary)
        codes = [float(("zero", "flux", "periodic").index(side)) for sides in self.boundary for side in sides]
        parameters = [*codes, *self.length, float(faces == "arithmetic")]
        null_spaces = () if is_held else (kappa.new_empty(0).detach(),) * 2
        super().__init__(list(kappa.shape[1:]), parameters, [kappa.unsqueeze(1), shift], null_spaces)

    def boundary_rhs(self, values: OfSides = 0.0, fluxes: OfSides = 0.0) -> Tensor:
        """The part of b that given values and fluxes at the sides make, (batch or 1, 1, *shape), with gradients.

        Args:
            values: u on the sides that are "zero".
            fluxes: what flows in, κ ∂u/∂n with the normal n pointing outwards, on the sides that are "flux".
                Each is one number for all sides, or a pair (low, high) for each axis; a number, or a tensor that
                broadcasts to (batch or 1, *side), where side is shape without the axis.

        Raises:
            ValueError: one of them stands where no side takes it.
        """
        values, fluxes = self._of_sides("values", values, "zero"), self._of_sides("fluxes", fluxes, "flux")
        b = torch.zeros_like(self.kappa)
        for axis, sides in enumerate(self.boundary):
            h = self.length[axis] / self.shape[axis]
            for end, side in enumerate(sides):
                if side == "periodic":
                    continue
                at_side = self.kappa.select(axis + 1, -end)
                given = (values if side == "zero" else fluxes)[axis][end]
                _check_of_side("values" if side == "zero" else "fluxes", given, at_side)
                added = 2 * at_side * given / h**2 if side == "zero" else torch.ones_like(at_side) * given / h
                if added.shape[0] != b.shape[0]:
                    b = b.expand(added.shape[0], *b.shape[1:])
                place = torch.zeros(self.shape[axis], dtype=b.dtype, device=b.device)
                place[-end] = 1.0
                b = b + added.unsqueeze(axis + 1) * place.view(-1, *(1,) * (len(self.shape) - axis - 1))
        return b.unsqueeze(1)

    def _of_sides(self, name: str, given: OfSides, kind: Side) -> Sequence[Sequence[Number]]:
        """A value for each side, (low, high) for each axis; only sides of this kind take one that is not zero."""
        dim = len(self.shape)
        if isinstance(given, (int, float, Tensor)):
            pairs: Sequence[Sequence[Number]] = [(given, given)] * dim
            stray = _is_given(given) and not any(kind in sides for sides in self.boundary)
        else:
            pairs = given
            of_axes = isinstance(given, (tuple, list)) and len(given) == dim
            if not of_axes or any(not isinstance(pair, (tuple, list)) or len(pair) != 2 for pair in given):
                raise ValueError(
                    f"Diffusion: {name} must be one for all sides or a pair (low, high) for each of {dim} axes, got "
                    f"{given!r:.80}"
                )
            stray = any(
                _is_given(value) and side != kind
                for sides, pair in zip(self.boundary, pairs, strict=True)
                for side, value in zip(sides, pair, strict=True)
            )
        if stray:
            raise ValueError(
                f"Diffusion: {name} belong to sides that are {kind!r}; the boundary is {self.boundary}, in pairs "
                f"(low, high), and {name} are {given!r:.80}"
            )
        return pairs


def _sides(boundary: Sides, dim: int) -> list[tuple[str, ...]]:
    """The pair (low, high) of each axis."""
    axes = [boundary] * dim if isinstance(boundary, str) else boundary
    pairs: list[tuple[str, ...]] = [
        (of_axis, of_axis) if isinstance(of_axis, str) else tuple(of_axis) for of_axis in axes
    ]
    known = {"zero", "flux", "periodic"}
    if len(pairs) != dim or any(len(pair) != 2 or not set(pair) <= known for pair in pairs):
        raise ValueError(
            "Diffusion: boundary must be 'zero', 'flux' or 'periodic': one for all sides, or one, or a pair "
            f"(low, high), for each of {dim} axes, got {boundary!r}"
        )
    if any(pair.count("periodic") == 1 for pair in pairs):
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
