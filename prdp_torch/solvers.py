"""Solvers: a method, its maximum number of iterations and its tolerance.

All start from zero unless they are given a start, and stop, sample by sample, at the first of
‖b - A u‖ <= rtol ‖b‖ (the true residual) or `max_iter` iterations; rtol = 0 runs exactly `max_iter`.
Arguments out of range raise ValueError.
"""

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

import torch
from torch import Tensor

from prdp_torch import _C, _check
from prdp_torch.operators import Operator
from prdp_torch.types import CheckpointEvery

Preconditioner: TypeAlias = 'Literal["diagonal", "multigrid"] | Operator | Multigrid | None'
PackedOptions: TypeAlias = tuple[list[str], list[int], list[float], list[Tensor]]


@dataclass
class Solver:
    """The base of all solvers, whose arguments every solver takes.

    Args:
        max_iter: K >= 0, the maximum number of iterations. With a tolerance it is a limit that solves should not reach,
            such as 1000.
        rtol: >= 0, 1e-5 by default. A sample stops when ‖b - A u‖ <= rtol ‖b‖. With 0, all max_iter iterations run.
        preconditioner: only for `CG`, `BiCGStab`, `GMRES` and `MINRES`. M ≈ A, whose inverse they apply in every
            iteration: None; "diagonal"; "multigrid", or a `Multigrid` with settings of its own; or an operator of
            `prdp_torch.operators` whose product is M⁻¹ r, such as `Function(apply, transpose)`. The adjoint solve
            applies its transpose. Derivatives take it for a constant, except the diagonal in unrolled mode.

    Raises:
        ValueError, TypeError: an argument is out of range or of a wrong type.
    """

    max_iter: int
    rtol: float = _C.DEFAULT_RTOL
    preconditioner: Preconditioner = field(default=None, kw_only=True)

    restart: int = field(
        default=_C.DEFAULT_RESTART, init=False, repr=False, compare=False
    )  # an argument of GMRES alone
    method: ClassVar[str]

    def __post_init__(self) -> None:
        who = type(self).__name__
        if type(self) is Solver:
            raise TypeError("Solver: is the base of all solvers; take one of them, such as CG or GMRES")
        check_preconditioner(who, self.preconditioner)
        if not torch.compiler.is_compiling():
            self.max_iter = _check.whole(who, "max_iter", self.max_iter)
            self.rtol = _check.real(who, "rtol", self.rtol)
            check_solver(who, self.method, self.max_iter, self.rtol, self.restart, self.preconditioner)

    if not TYPE_CHECKING:

        def __setattr__(self, name: str, value: object) -> None:
            settings = [f.name for f in fields(self) if f.init]
            if name not in settings and type(self).__module__ == __name__:  # it would have no effect
                raise AttributeError(f"{type(self).__name__}: no setting '{name}'; allowed: {', '.join(settings)}")
            object.__setattr__(self, name, value)


PRECONDITIONERS = ("diagonal", "multigrid")


def check_preconditioner(who: str, preconditioner: object) -> None:
    """Raise ValueError or TypeError for what no solver takes."""
    if isinstance(preconditioner, str) and preconditioner not in PRECONDITIONERS:
        names = ", ".join(map(repr, (None, *PRECONDITIONERS)))
        raise ValueError(f"{who}: unknown preconditioner {preconditioner!r}; allowed: {names}, or an operator")
    if not isinstance(preconditioner, str | Operator | Multigrid | None):
        hint = "; a function that returns M⁻¹ r is operators.Function(apply)" if callable(preconditioner) else ""
        raise TypeError(
            f"{who}: preconditioner must be a name or an operator of prdp_torch.operators, "
            f"got {_check.shown(preconditioner):.80}{hint}"
        )


def packed_options(
    method: str,
    max_iter: int,
    rtol: float,
    restart: int,
    preconditioner: Preconditioner,
    backward: str = "implicit",
    adjoint_max_iter: int | None = None,
    adjoint_rtol: float | None = None,
    on_failure: str = "raise",
    checkpoint_every: CheckpointEvery = None,
    start: str = "zero",
    adjoint_log: int = 0,
    rtol_bits: int = -1,
    adjoint_rtol_bits: int = -1,
) -> PackedOptions:
    """All options of a solve in the four lists that the ops take: csrc/prdp/autograd/packed_options.h unpacks them.
    With `rtol_bits`, the bits of a tolerance take its place."""
    shape: list[int] = []
    parameters: list[float] = []
    tensors: list[Tensor] = []
    if isinstance(preconditioner, Operator):
        kind, shape = preconditioner.kind, preconditioner.shape
        parameters, tensors = preconditioner.parameters, preconditioner.tensors
    elif isinstance(preconditioner, Multigrid):
        kind, shape = "multigrid", [preconditioner.smoothing]
    else:
        kind = preconditioner or ""
    every = checkpoint_every or 0
    counts = [
        max_iter,
        restart,
        adjoint_log,
        _C.CHECKPOINT_SQRT if every == "sqrt" else every,
        int(adjoint_max_iter is not None),
        adjoint_max_iter or 0,
        0,  # M as it is, not its transpose
        rtol_bits,
        adjoint_rtol_bits,
        *shape,
    ]
    numbers = [rtol, float(adjoint_rtol is not None), adjoint_rtol or 0.0, *parameters]
    return [method, backward, on_failure, start, kind], counts, numbers, tensors


def check_solver(who: str, *solver: Any, **others: Any) -> _C.SolveOptions:
    """Raise ValueError, in the name of `who`, unless the parts of a solver fit together; return them as options."""
    options = _C.SolveOptions(*packed_options(*solver, **others))
    options.check(who)
    return options


@dataclass
class Jacobi(Solver):
    """Jacobi's method, u ← D⁻¹(b - (L + U) u), where A = D + L + U and D is the diagonal. It converges if the
    spectral radius of D⁻¹(L + U) is below 1. It takes no preconditioner."""

    method: ClassVar[str] = "jacobi"


@dataclass
class Chebyshev(Solver):
    """Chebyshev's semi-iteration over Jacobi's method. It takes fewer iterations than `Jacobi`, about √n in place of n,
    and an iteration costs the same. Its weights need the spectrum of A, which is known for `Heat` and `Poisson`
    only; a solve raises ValueError for other operators. It takes no preconditioner.

    Source: Golub and Varga 1961.
    """

    method: ClassVar[str] = "chebyshev"


@dataclass
class SteepestDescent(Solver):
    """Steepest descent for definite operators: α = r·r / r·Ar; u += α r; r -= α A r. It takes no preconditioner."""

    method: ClassVar[str] = "steepest_descent"


@dataclass
class CG(Solver):
    """Conjugate gradients, for symmetric definite operators.

    `preconditioner="diagonal"` divides by the diagonal. It saves the more the more the diagonal varies, as with a
    diffusivity that jumps, and nothing where it is constant. A zero on the diagonal is refused (ZERO_DIAGONAL). A
    preconditioner of your own must be symmetric and definite. Where it is not definite, a sample ends with BREAKDOWN;
    where it is not symmetric, rtol is not reached, and a warning says so.

    Source: Hestenes and Stiefel 1952.
    """

    method: ClassVar[str] = "cg"


@dataclass
class BiCGStab(Solver):
    """BiCGStab, for any operator. An iteration has two products with A, and memory does not grow with the number of
    iterations, as it does with the restart length of GMRES. The residual may rise on its way down.

    Source: van der Vorst 1992.
    """

    method: ClassVar[str] = "bicgstab"


@dataclass
class MINRES(Solver):
    """The minimal residual for symmetric operators, definite or not, as a Helmholtz equation or a saddle point.

    An iteration has one product with A, and memory does not grow with their number, as it does in a cycle of `GMRES`.
    Where A is definite, `CG` takes less work per iteration. A preconditioner must be symmetric, and positive definite,
    else a sample ends with BREAKDOWN. The built-in ones are where A is: not of `Poisson`, whose A is negative definite.

    Source: Paige and Saunders 1975.
    """

    method: ClassVar[str] = "minres"


@dataclass(kw_only=True)
class GMRES(Solver):
    """Restarted GMRES(m), for any operator. A cycle has m = `restart` products, 10 by default, and `max_iter` counts
    cycles.

    `restart` is at least 1. The residual never grows. In float32 unrolled gradients can be far off, so prefer implicit
    ones. A preconditioner is applied from the right, so the residual stays that of A u = b.

    Source: Saad and Schultz 1986.
    """

    restart: int = _C.DEFAULT_RESTART

    method: ClassVar[str] = "gmres"

    def __post_init__(self) -> None:
        if not torch.compiler.is_compiling():
            self.restart = _check.whole("GMRES", "restart", self.restart)
        super().__post_init__()


@dataclass
class Multigrid(Solver):
    """Multigrid, as a method and as a preconditioner: the number of iterations does not grow with the grid.

    An iteration is one V-cycle. It is for `Heat`, `Poisson`, `Burgers`, `Diffusion`, and for `Stencil` with neighbours
    at most one cell away, in one to three dimensions, of any size and with any coefficients. As a preconditioner of
    `CG` and `MINRES`, or of `GMRES` and `BiCGStab` if A is not symmetric, it takes fewer cycles and is more robust;
    so does `NavierStokes`, with `GMRES` or `BiCGStab`. There, `max_iter` and `rtol` have no influence. Unrolled
    gradients of A take the cycles for constants.

    Args:
        max_iter, rtol: as those of every `Solver`; a cycle counts as an iteration.
        smoothing: >= 1, the smoothing steps before and after each coarse grid.

    Examples:
        >>> solver = prdp.CG(max_iter=50, preconditioner="multigrid")
        >>> solver = prdp.CG(max_iter=50, preconditioner=prdp.Multigrid(smoothing=3))

    Source: black-box multigrid (Dendy 1982, 1983), coarsened one axis at a time.
    """

    max_iter: int = 20
    preconditioner: Preconditioner = field(init=False, repr=False, compare=False)
    smoothing: int = field(default=2, kw_only=True)

    method: ClassVar[str] = "multigrid"

    def __post_init__(self) -> None:
        self.smoothing = _check.whole("Multigrid", "smoothing", self.smoothing)
        if self.smoothing < 1:
            raise ValueError(f"Multigrid: smoothing must be >= 1, got {self.smoothing}")
        vars(self)["preconditioner"] = self  # as a method, its cycles are M⁻¹
        super().__post_init__()


@dataclass
class Direct(Solver):
    """The cheapest exact method of the operator: Thomas' algorithm in 1D; sine transforms, FFT or products along the
    axes for constant coefficients in a box; else LU or Cholesky, banded, sparse or dense. It takes no preconditioner.

    Args:
        max_iter: 1 by default. An iteration is one direct solve; those after the first refine its result.
    """

    max_iter: int = 1

    method: ClassVar[str] = "direct"


def solve_options(
    method: str, rtol: float, restart: int, preconditioner: Preconditioner, _made_of: object, *others: Any
) -> _C.SolveOptions:
    """All options but max_iter, as the compiled library takes them past the dispatcher. `_made_of` only lets `Kept`
    notice new tensors of the preconditioner."""
    return _C.SolveOptions(*packed_options(method, 0, rtol, restart, preconditioner, *others))


def tensors_of(preconditioner: Preconditioner) -> tuple[int, ...]:
    """What tells whether a preconditioner that is the same object is made of others than before."""
    if isinstance(preconditioner, Multigrid):
        return (preconditioner.smoothing,)
    return tuple(map(id, preconditioner.tensors)) if isinstance(preconditioner, Operator) else ()


def check_options(
    who: str,
    solver: object,
    backward: object,
    adjoint_max_iter: object,
    adjoint_rtol: object,
    on_failure: object,
    checkpoint_every: CheckpointEvery,
    start: object = "zero",
) -> _C.SolveOptions:
    """The arguments that every solve takes, as options: TypeError or ValueError in the name of `who`."""
    if not isinstance(solver, Solver):
        raise TypeError(f"{who}: solver must be a Solver such as Jacobi(10), got {_check.shown(solver)}")
    return check_settings(
        who,
        solver.method,
        solver.max_iter,
        solver.rtol,
        solver.restart,
        solver.preconditioner,
        backward,
        adjoint_max_iter,
        adjoint_rtol,
        on_failure,
        checkpoint_every,
        start,
    )


def check_settings(
    who: str,
    method: str,
    max_iter: object,
    rtol: object,
    restart: object,
    preconditioner: Preconditioner,
    backward: object,
    adjoint_max_iter: object,
    adjoint_rtol: object,
    on_failure: object,
    checkpoint_every: Any,
    start: object,
) -> _C.SolveOptions:
    """The same for the parts of a solver: they and the options fit together."""
    check_preconditioner(who, preconditioner)
    if isinstance(checkpoint_every, str) and checkpoint_every != "sqrt":
        raise TypeError(f"{who}: checkpoint_every must be a whole number, 'sqrt' or None, got {checkpoint_every!r}")
    if checkpoint_every not in (None, "sqrt") and _check.whole(who, "checkpoint_every", checkpoint_every) < 1:
        raise ValueError(f"{who}: checkpoint_every must be >= 1, 'sqrt' or None, got {checkpoint_every}")
    return check_solver(
        who,
        method,
        _check.whole(who, "max_iter", max_iter),
        _check.real(who, "rtol", rtol),
        _check.whole(who, "restart", restart),
        preconditioner,
        backward=_check.string(who, "backward", backward),
        adjoint_max_iter=_check.optional(_check.whole, who, "adjoint_max_iter", adjoint_max_iter),
        adjoint_rtol=_check.optional(_check.real, who, "adjoint_rtol", adjoint_rtol),
        on_failure=_check.string(who, "on_failure", on_failure),
        checkpoint_every=checkpoint_every,
        start=_check.string(who, "start", start),
    )
