"""Solvers: a method, its maximum number of iterations and its tolerance.

All start from zero unless they are given a start, and stop, sample by sample, at the first of
‖b - A u‖ <= rtol ‖b‖ (the true residual) or `max_iter` iterations; rtol = 0 runs exactly `max_iter`.
Arguments out of range raise ValueError.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import torch

from prdp_torch import _C, _check


@dataclass
class Solver:
    """The base of all solvers, whose arguments every solver takes.

    Args:
        max_iter: K >= 0, the maximum number of iterations.
        rtol: >= 0. A sample stops when ‖b - A u‖ <= rtol ‖b‖. With 0, exactly max_iter iterations run.
        preconditioner: None, or the name of one; only for `CG` and `GMRES`.

    Raises:
        ValueError, TypeError: an argument is out of range or of a wrong type.
    """

    max_iter: int
    rtol: float = _C.DEFAULT_RTOL
    preconditioner: str | None = field(default=None, kw_only=True)

    restart: ClassVar[int] = _C.DEFAULT_RESTART
    method: ClassVar[str]
    preconditioners: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self):
        self._check_preconditioner()
        if self.preconditioner is not None:
            self.method = f"{type(self).method}_{self.preconditioner}"
        if not torch.compiler.is_compiling():
            who = type(self).__name__
            self.max_iter = _check.whole(who, "max_iter", self.max_iter)
            self.rtol = _check.real(who, "rtol", self.rtol)
            _C.check_solver(who, self.method, self.max_iter, self.rtol, self.restart)

    def _check_preconditioner(self):
        who, name, allowed = type(self).__name__, self.preconditioner, self.preconditioners
        if name is None or name in allowed:
            return
        if not allowed:
            raise ValueError(f"{who}: takes no preconditioner, got {name!r}; CG and GMRES take one")
        names = ", ".join(map(repr, (None, *allowed)))
        raise ValueError(f"{who}: unknown preconditioner {name!r}; allowed: {names}")


@dataclass
class Jacobi(Solver):
    """Jacobi's method, u ← D⁻¹(b - (L + U) u), where A = D + L + U and D is the diagonal. It converges if the
    spectral radius of D⁻¹(L + U) is below 1."""

    method: ClassVar[str] = "jacobi"


@dataclass
class Chebyshev(Solver):
    """Chebyshev's semi-iteration over Jacobi's method. It takes two to three times fewer iterations than `Jacobi`,
    and an iteration costs the same. Its weights need the spectrum of A, which is known for `Heat` and `Poisson`
    only.

    Source: Golub and Varga 1961.
    """

    method: ClassVar[str] = "chebyshev"


@dataclass
class SteepestDescent(Solver):
    """Steepest descent for definite operators: α = r·r / r·Ar; u += α r; r -= α A r."""

    method: ClassVar[str] = "steepest_descent"


@dataclass
class CG(Solver):
    """Conjugate gradients, for symmetric definite operators.

    `preconditioner="diagonal"` divides by the magnitude of the diagonal. Where the diagonal varies much, as with a
    diffusivity that varies in space, this saves most of the iterations. If the diagonal is constant, it saves
    none. A zero on the diagonal is refused (ZERO_DIAGONAL).

    Source: Hestenes and Stiefel 1952.
    """

    method: ClassVar[str] = "cg"
    preconditioners: ClassVar[tuple[str, ...]] = ("diagonal",)


@dataclass
class BiCGStab(Solver):
    """BiCGStab, for any operator. An iteration has two products with A, and memory does not grow with the number of
    iterations, as it does with the restart length of GMRES. The residual may rise on its way down.

    Source: van der Vorst 1992.
    """

    method: ClassVar[str] = "bicgstab"


@dataclass(kw_only=True)
class GMRES(Solver):
    """Restarted GMRES(m), for any operator. A cycle has m = `restart` products, and `max_iter` counts cycles.

    The residual never grows. In float32 unrolled gradients can be far off, so prefer implicit ones.

    Two preconditioners are applied from the right. "diagonal" divides by the diagonal, which must have no zero
    (ZERO_DIAGONAL). "stokes", for `NavierStokes` only, solves the same step without winds by FFTs; GMRES then
    reaches 1e-5 in few products, but in more time, as these run as tensor operations.

    Source: Saad and Schultz 1986.
    """

    restart: int = _C.DEFAULT_RESTART

    method: ClassVar[str] = "gmres"
    preconditioners: ClassVar[tuple[str, ...]] = ("diagonal", "stokes")

    def __post_init__(self):
        if not torch.compiler.is_compiling():
            self.restart = _check.whole("GMRES", "restart", self.restart)
        super().__post_init__()


@dataclass
class Direct(Solver):
    """The cheapest exact method of the operator: Thomas in 1D, sine transform in 2D and 3D, LU for
    matrices. An iteration is one direct solve; those after the first refine its result."""

    max_iter: int = 1

    method: ClassVar[str] = "direct"


class Kept:
    """An object of the compiled library, made anew by `make` where the values that it is made of have changed.
    Copies and pickles begin without one."""

    def __init__(self, make):
        self.make, self._last = make, (None, None)

    def of(self, *values):
        last = self._last
        if last[0] != values:
            last = self._last = values, self.make(*values)
        return last[1]

    def __deepcopy__(self, memo):
        return Kept(self.make)

    def __reduce__(self):
        return Kept, (self.make,)


def checkpoint_number(checkpoint_every):
    """`checkpoint_every` as the compiled library takes it."""
    return {None: 0, "sqrt": _C.CHECKPOINT_SQRT}.get(checkpoint_every, checkpoint_every)


def check_options(who, solver, backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every, start="zero"):
    """The arguments that every solve takes: TypeError or ValueError in the name of `who`."""
    if not isinstance(solver, Solver):
        raise TypeError(f"{who}: solver must be a Solver such as Jacobi(10), got {solver!r}")
    if checkpoint_every not in (None, "sqrt") and _check.whole(who, "checkpoint_every", checkpoint_every) < 1:
        raise ValueError(f"{who}: checkpoint_every must be >= 1, 'sqrt' or None, got {checkpoint_every}")
    _C.check_options(
        who,
        solver.method,
        _check.whole(who, "max_iter", solver.max_iter),
        _check.real(who, "rtol", solver.rtol),
        _check.whole(who, "restart", solver.restart),
        _check.string(who, "backward", backward),
        _check.optional(_check.whole, who, "adjoint_max_iter", adjoint_max_iter),
        _check.optional(_check.real, who, "adjoint_rtol", adjoint_rtol),
        _check.string(who, "on_failure", on_failure),
        checkpoint_number(checkpoint_every),
        _check.string(who, "start", start),
    )
