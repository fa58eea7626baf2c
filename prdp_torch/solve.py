"""`linear_solve`, and the reports of solves."""

import math
from collections import Counter
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from prdp_torch import _C, _check, operators, torch_private
from prdp_torch.operators.matrix import hint_for
from prdp_torch.solvers import Solver, check_options, packed_options
from prdp_torch.types import Backward, CheckpointEvery, OnFailure, Solution

_STATUSES: dict[str, int] = _C.SOLVE_STATUSES


class SolveStatus(IntEnum):
    """Why a solve stopped, one value per sample; positive: solved (docs/stability.md)."""

    CONVERGED_BREAKDOWN = _STATUSES["CONVERGED_BREAKDOWN"]
    CONVERGED = _STATUSES["CONVERGED"]
    MAX_ITER = _STATUSES["MAX_ITER"]
    STAGNATED = _STATUSES["STAGNATED"]
    DIVERGED = _STATUSES["DIVERGED"]
    OVERFLOW = _STATUSES["OVERFLOW"]
    BREAKDOWN = _STATUSES["BREAKDOWN"]
    ZERO_DIAGONAL = _STATUSES["ZERO_DIAGONAL"]
    INCONSISTENT = _STATUSES["INCONSISTENT"]
    NONFINITE_INPUT = _STATUSES["NONFINITE_INPUT"]
    NONFINITE_OPERATOR = _STATUSES["NONFINITE_OPERATOR"]


class AdjointLog:
    """Where a backward pass leaves the report of its adjoint solve: nobody is there to return it to."""

    def __init__(self) -> None:
        self._kept = _C.AdjointLog()  # closes the log with it
        self.number: int = self._kept.number

    def number_in_graph(self) -> int:
        """`number` as torch.compile takes it, which otherwise compiles again for each log."""
        compiling = torch.compiler.is_dynamo_compiling()
        number: int = torch_private.number_as_graph_input(self, "number") if compiling else self.number
        return number

    def read(self) -> "SolveInfo | None":
        return _as_info(_C.read_adjoint_log(self.number))

    def __deepcopy__(self, memo: dict[int, Any]) -> "AdjointLog":
        return AdjointLog()

    def __reduce__(self) -> tuple[Any, ...]:
        return AdjointLog, ()


class LogOfStep(AdjointLog):
    """The log of one step in a compiled rollout. The graph holds a single log, which owns the numbers that follow its
    own, one for each step (adjoint_log.h)."""

    def __init__(self, log: AdjointLog, step: int) -> None:
        self.number = log.number_in_graph() + 1 + step


class LogOfRollout(AdjointLog):
    """One log for a row of steps, read as (batch, steps)."""

    def __init__(self, log: AdjointLog, steps: int) -> None:
        self.log, self.steps = log, steps

    def of_step(self, step: int) -> LogOfStep:
        """`step` is counted from 0."""
        return LogOfStep(self.log, step)

    def read(self) -> "SolveInfo | None":
        return _as_info(_C.join_adjoint_logs([self.of_step(step).number for step in range(self.steps)]))


class AdjointLogs(list[AdjointLog]):
    """The logs of a row of steps, one each; read as (batch, steps)."""

    def __init__(self, steps: int = 0) -> None:
        super().__init__(AdjointLog() for _ in range(steps))

    def read(self) -> "SolveInfo | None":
        return _as_info(_C.join_adjoint_logs([log.number for log in self]))


def _as_info(report: tuple[Any, ...] | None) -> "SolveInfo | None":
    return None if report is None else SolveInfo(*report)


class SolveInfo(NamedTuple):
    """The report of a solve, with one value per sample: tensors of shape (batch,). The report of a rollout has one
    value per sample and step: (batch, steps).

    Attributes:
        iterations: those that produced the returned u (int64).
        residual: ‖b - A u‖ / ‖b‖, recomputed from the returned u (dtype of u).
        status: why the solve stopped (int64). `SolveStatus(int(info.status[0])).name` is its name.
        operator_applications: the number of products with A (int64).
        floor: where the dtype cannot reach rtol, the relative residual that its rounding leaves, ε ‖A‖ ‖u‖ / ‖b‖. Such
            a sample is STAGNATED: its residual is as small as the dtype allows. u may be further off where A is badly
            conditioned; float64 tells. 0 for all other samples, those that failed among them.
        log: for `adjoint`.
        way: how it was computed: "kernel", in one launch on a GPU, "loops" of the CPU, or "tensors", in operations of
            torch, which are slow on a GPU. Empty where that is not known: in an adjoint's report, and under
            `torch.compile`.
    """

    iterations: Tensor
    residual: Tensor
    status: Tensor
    operator_applications: Tensor
    floor: Tensor
    log: AdjointLog | AdjointLogs | None = None
    way: str = ""

    def __repr__(self) -> str:
        if self.status.is_meta:
            return f"SolveInfo({self.status.numel()} samples on meta)"
        found = Counter(SolveStatus(s).name for s in self.status.flatten().tolist())
        statuses = ", ".join(f"{count} {name}" for name, count in found.items())
        ranges = ", ".join(
            _range(name, values)
            for name in ("iterations", "residual", "operator_applications")
            if (values := getattr(self, name).flatten().tolist())
        )
        way = f"; {self.way}" if self.way == "kernel" or self.status.device.type != "cpu" else ""
        return f"SolveInfo({statuses}; {ranges}{way})"

    @property
    def failed(self) -> Tensor:
        """Which samples failed (bool): their status is below STAGNATED."""
        return self.status < _STATUSES["STAGNATED"]

    @property
    def solved(self) -> Tensor:
        """Which samples are solved (bool): they met the tolerance, or came as near as their dtype allows. With rtol = 0
        only those do whose residual is 0."""
        return (self.status > 0) | (self.floor > 0)

    @property
    def adjoint(self) -> "SolveInfo | None":
        """The report of the adjoint solve, or None before `backward()`.

        Unrolled mode has one only for samples that get the implicit derivative, as those solved to rounding. The
        report of the others has the iterations and the status of the solve itself, NaN as the residual, and the
        number of products in the whole backward pass."""
        return None if self.log is None else self.log.read()


def _range(name: str, values: list[float]) -> str:
    known = [value for value in values if not math.isnan(value)]
    return f"{name} {min(known):g} to {max(known):g}" if known else f"{name} not measured"


def detach_failed(u: Tensor, info: SolveInfo) -> Tensor:
    """Return u with its failed samples as constants, so that no gradient passes through them.

    A solve with on_failure="zero_grad" passes no gradient through a failed sample itself. Use this function if the
    loss depends on the weights in other ways too, for example through a network after the step.

    Args:
        u: (batch, ...), or the states (batch, steps + 1, ...) of a rollout.
        info: the `SolveInfo` of the solve or the rollout. In a rollout, a sample is constant from its first failed
            step on.

    Returns:
        A tensor with the shape and the values of u. If no sample failed, u itself.

    Raises:
        ValueError: u and info differ in their batch or their steps.
        TypeError: info is no `SolveInfo`: a step has none before its first call.

    Examples:
        >>> loss = (network(prdp.detach_failed(step(u), step.info)) - reference).square().mean()
    """
    if not isinstance(info, SolveInfo):
        raise TypeError(f"detach_failed: info must be the SolveInfo of the solve that made u, got {info!r:.80}")
    constant: Tensor = torch.ops.prdp.detach_failed(u, info.status)
    return constant


def linear_solve(
    A: operators.Operator | Tensor,
    b: Tensor,
    solver: Solver,
    backward: Backward = "implicit",
    adjoint_max_iter: int | None = None,
    adjoint_rtol: float | None = None,
    on_failure: OnFailure = "raise",
    checkpoint_every: CheckpointEvery = None,
    x0: Tensor | None = None,
) -> tuple[Tensor, SolveInfo]:
    """Solve A u = b, with gradients for A and b.

    Args:
        A: an operator of `prdp_torch.operators`, or a tensor (n, n) or (batch, n, n), dense or sparse CSR.
        b: (batch, channel, *shape) for stencil operators, (n,) or (batch, n) for matrices; float32 or
            float64, any strides.
        solver: `Jacobi`, `Chebyshev`, `SteepestDescent`, `CG`, `BiCGStab`, `GMRES`, `MINRES`, `Multigrid` or `Direct`.
        backward: how the gradient is computed.
            "implicit" solves one adjoint system, Aᵀλ = ū, with the same method. Then b̄ = λ, and a tensor g
            in A gets ḡ = -λᵀ ∂(A u)/∂g. "unrolled" differentiates the iterations that ran. "none" gives no
            gradient.
        adjoint_max_iter, adjoint_rtol: limits of the adjoint solve. None takes those of the solver.
        on_failure: what happens if a sample diverges, overflows, breaks down or is not finite: "raise" a
            torch.linalg.LinAlgError that names the samples, "warn", "return", or "zero_grad". The last returns as
            "return" does, and b and A get no gradient from the samples whose forward or adjoint solve failed.
            Reaching max_iter is not a failure.
        checkpoint_every: for "unrolled" only. The backward pass runs the iterations again, on the CPU one sample at
            a time, and holds their K iterates. With a number n it holds every n-th one and recomputes those between;
            "sqrt" stands for n = ⌈√K⌉, and None holds all. The gradient is the same bit for bit.
        x0: a guess of u, with the shape, dtype and device of b. Each sample starts from α x0, where
            α = ⟨b, A x0⟩ / ⟨A x0, A x0⟩ minimises the residual. So the start is never worse than zero, and the
            length of x0 does not matter. It costs one product. rtol stays relative to ‖b‖. x0 gets no
            gradient: the unrolled derivative is that of the iterations from a fixed α x0. The adjoint solve
            starts from zero, and `Direct` ignores x0.

    Returns:
        (u, info): u with the shape of b, and a `SolveInfo`.

    Raises:
        ValueError, TypeError: an argument is wrong. This is checked before any work.
        torch.linalg.LinAlgError: a sample failed, in the forward or the backward pass, and on_failure is "raise".

    Examples:
        >>> A = prdp.operators.Heat((30,), nu=1e-3, dt=1.0)
        >>> u, info = prdp.linear_solve(A, b, prdp.CG(max_iter=20))  # b: (batch, 1, 30)

    Source of the derivatives: Bhatia, Koehler, Thuerey, "Progressively Refined Differentiable
    Physics", ICLR 2025, section 2.1.
    """
    if isinstance(A, torch.Tensor):
        A = operators.Matrix(A)
    if not isinstance(A, operators.Operator):
        raise TypeError(f"linear_solve: A must be an operator or a tensor, got {type(A).__name__}{hint_for(A)}")
    compiling = torch.compiler.is_compiling()
    log: AdjointLog | None = None
    found: Solution | None = None
    if not compiling:
        _check.dense("linear_solve", "b", b)
        if x0 is not None:
            _check.dense("linear_solve", "x0", x0)
    lone_vector = b.dim() == 1 and isinstance(A, operators.Matrix)
    rhs = b.unsqueeze(0) if lone_vector else b
    start = x0.unsqueeze(0) if lone_vector and x0 is not None else x0
    settings = backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every
    if not compiling:
        options = check_options("linear_solve", solver, *settings)
        log = AdjointLog()
        if vars(A).setdefault("_solves", 0) == 1:
            A.explain_freed_graphs()  # at its second solve: an operator made anew for each update never gets here
        vars(A)["_solves"] += 1
        # None where a mode or subclass in Python is to see the op
        found = _C.linear_solve(
            rhs, A.tensors, A.kind, A.shape, A.parameters, options, solver.max_iter, log.number, start
        )
    if found is None:
        parts = solver.method, solver.max_iter, solver.rtol, solver.restart, solver.preconditioner
        packed = packed_options(*parts, *settings, adjoint_log=0 if log is None else log.number)
        solution: Solution = torch.ops.prdp.linear_solve(
            rhs, A.tensors, A.kind, A.shape, A.parameters, False, start, *packed
        )
        found = solution
    way = "" if compiling else _C.way_of_last_solve()
    return found[0].squeeze(0) if lone_vector else found[0], SolveInfo(*found[1:], log, way)
