"""`Stepper`: what all steppers have in common, and the base of those that solve A(u) u_next = b(u)."""

import contextvars
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor

from prdp_torch import _C, _check, operators, torch_private
from prdp_torch.batching import outlive_transforms
from prdp_torch.calls import forgets_if_it_raises
from prdp_torch.controller_interval import has_controller
from prdp_torch.operators.base import full_precision
from prdp_torch.operators.matrix import as_operator
from prdp_torch.solve import AdjointLog, AdjointLogs, LogOfRollout, SolveInfo, SolveStatus, linear_solve
from prdp_torch.solvers import GMRES, Solver
from prdp_torch.stepper_settings import HasSettings
from prdp_torch.types import Backward, CheckpointEvery, OnFailure, Report, Solution, Start

_REFUSED = int(SolveStatus.NONFINITE_INPUT)  # this, or less: before the first iteration


@dataclass
class _Call:
    """A call of a module by its rollout, in the context of that call alone: threads and interrupts leave no trace."""

    stepper: "Stepper"
    log: AdjointLog
    outer: "_Call | None"
    info: SolveInfo | None = None


_call: contextvars.ContextVar[_Call | None] = contextvars.ContextVar("prdp_call_of_rollout", default=None)


def _make(call: _Call, u: Tensor) -> Tensor:
    _call.set(call)
    return call.stepper(u)


def _take_over(context: contextvars.Context) -> None:
    """Copy what the call has set, in a copy of the context, into ours: it stays set, as after any other call."""
    for variable, value in context.items():
        if variable is not _call and variable.get(None) is not value:
            variable.set(value)


class Stepper(HasSettings):
    """The base of all steppers. A stepper maps a state u to the next one by solving A(u) u_next = b(u).

    States are (batch, channel, *shape) in float32 or float64, with any strides. Gradients are computed as
    `linear_solve` describes.

    The arguments below are those that every stepper takes beside its physics. A subclass defines `operator(u)`, and
    `rhs(u)` if b(u) is not the state itself. `ImplicitStep` takes the two as functions instead.

    Args:
        solver: `Jacobi`, `Chebyshev`, `SteepestDescent`, `CG`, `BiCGStab`, `GMRES`, `MINRES`, `Multigrid` or `Direct`.
            Its settings are copied: set those of the stepper later, not those of the solver.
        backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every: as in `linear_solve`.
        start: where the solves start: at "zero", or at "state", the state before the step, which then is the x0 of
            `linear_solve`. This saves iterations if a step changes the state little.

    Attributes:
        max_iter: K, the maximum number of iterations. You or a controller may set it at any time. Under
            `torch.compile` this does not compile again.
        rtol, adjoint_rtol: the tolerances. The same holds for them, and for adjoint_max_iter.
        start: as above. It may be set at any time.
        restart, preconditioner and the options above: they may be set at any time, and are checked then.
        info: the `SolveInfo` of the last forward pass or rollout; None before the first, and after one that raised
            (not under `torch.compile`).
        adjoint_info: the `SolveInfo` of the last backward pass; None before the first.

    Raises:
        ValueError, TypeError: an argument is wrong. This is checked before any work.
    """

    info: SolveInfo | None
    _is_rolling_out = False  # while a rollout calls the module in a graph

    if TYPE_CHECKING:

        def __call__(self, u: Tensor) -> Tensor: ...

    def __init__(
        self,
        solver: Solver,
        backward: Backward = "implicit",
        adjoint_max_iter: int | None = None,
        adjoint_rtol: float | None = None,
        on_failure: OnFailure = "raise",
        checkpoint_every: CheckpointEvery = None,
        start: Start = "zero",
        **unknown: object,
    ) -> None:
        who = type(self).__name__
        if unknown:
            raise TypeError(_unknown_argument(type(self), unknown))
        if type(self).operator is Stepper.operator and type(self).forward is Stepper.forward:
            raise TypeError(
                f"{who}: a subclass of Stepper must define operator(u), and rhs(u) where b is not the state; "
                "ImplicitStep(operator, rhs, solver) takes the two as functions"
            )
        super().__init__(solver, backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every, start)
        self._adjoint_log = AdjointLog()
        self._last_log: AdjointLog | AdjointLogs = self._adjoint_log
        self.info = None

    def operator(self, u: Tensor) -> operators.Operator | Tensor:
        """A(u), an operator of `prdp_torch.operators`."""
        raise NotImplementedError(f"{type(self).__name__}: operator(u) is not defined")

    def rhs(self, u: Tensor) -> Tensor:
        """b(u), the right-hand side of the step from u."""
        return u

    def _rhs_with(self, u: Tensor, a: operators.Operator) -> Tensor:
        """b(u), where a = A(u)."""
        return self.rhs(u)

    @forgets_if_it_raises
    def forward(self, u: Tensor) -> Tensor:
        """Return the next state, of the shape and dtype of u, (batch, channel, *shape). Call the module instead.

        Raises ValueError or TypeError for a u that does not fit, and with on_failure="raise" `torch.linalg.LinAlgError`
        where a sample fails."""
        log = self._log()
        found = self._solve(u, log)
        u_next, report = found[0], found[1:]
        self._keep(report, log, u_next)
        return u_next

    @forgets_if_it_raises
    def rollout(self, u: Tensor, steps: int) -> Tensor:
        """Repeat the step. Returns all states, u included: (batch, steps + 1, channel, *shape).

        `info` and `adjoint_info` then hold tensors of shape (batch, steps). If a step fails, the error gives its
        number, counted from 1. For the backward pass each step stores what a single step stores. Where a subclass
        has a forward of its own, or there are hooks, it repeats the calls of the module."""
        compiling = torch.compiler.is_compiling()
        if not compiling:
            _check.dense(type(self).__name__, "u", u)
            if _check.whole("rollout", "steps", steps) < 0:
                raise ValueError(f"rollout: steps must be >= 0, got {steps}")
        u = full_precision(u)
        logs = LogOfRollout(self._adjoint_log, steps) if compiling else AdjointLogs(steps)
        step_from = self._step_by_calling_module if self._calls_do_more_than(Stepper.forward) else self._solve
        states, reports = [u], []
        for step in range(steps):
            if isinstance(logs, LogOfRollout):
                found = step_from(states[-1], logs.of_step(step))
            else:
                with _C.StepOfRollout(step + 1, steps):
                    found = step_from(states[-1], logs[step])
            u_next, *of_step = found
            states.append(u_next)
            reports.append(of_step)
        if steps > 0:
            report = [torch.stack(of_steps, 1) for of_steps in zip(*reports, strict=False)]
        else:
            report = [
                u.new_empty((len(u), 0), dtype=t) for t in (torch.int64, u.dtype, torch.int64, torch.int64, u.dtype)
            ]
        all_states = torch.stack(states, 1)
        self._keep(cast(Report, tuple(report)) if all(reports) else None, logs, all_states)
        return all_states

    def _calls_do_more_than(self, forward: Callable[..., Tensor]) -> bool:
        """Whether a call of the module is more than this forward: a subclass or an attribute replaces it, or there are
        hooks."""
        is_replaced = type(self).forward is not forward or "forward" in vars(self)
        return is_replaced or torch_private.calls_have_hooks(self)

    def _step_by_calling_module(self, u: Tensor, log: AdjointLog) -> tuple[Tensor, ...]:
        """What a call of the module makes of u, and the report of its last step: none if it makes none."""
        if self._is_rolling_out or self._call_of_rollout() is not None:
            raise RuntimeError(
                f"{type(self).__name__}.rollout: it repeats the calls of the module, and its forward calls rollout; "
                "let the forward call the rollout of a step that the module holds"
            )
        if not torch.compiler.is_compiling():
            call = _Call(self, log, _call.get())
            context = contextvars.copy_context()
            state = context.run(_make, call, u)
            _take_over(context)
            return state, *(() if call.info is None else call.info[:5])
        own = self._adjoint_log
        self._adjoint_log, self.info, self._is_rolling_out = log, None, True
        try:
            state = self(u)
        finally:
            self._adjoint_log, self._is_rolling_out = own, False
        return state, *(() if self.info is None else self.info[:5])

    def _call_of_rollout(self) -> _Call | None:
        """The call of this module that a rollout makes, if it does."""
        if torch.compiler.is_compiling():
            return None
        call = _call.get()
        while call is not None and call.stepper is not self:
            call = call.outer
        return call

    def _log(self) -> AdjointLog:
        """Where a forward pass has its adjoint solve reported."""
        call = self._call_of_rollout()
        return self._adjoint_log if call is None else call.log

    def _keep(self, report: Report | None, log: AdjointLog | AdjointLogs, u: Tensor) -> None:
        """Keep the report of what made u. Without gradients, as in a validation, that of the last backward pass
        stays."""
        compiling = torch.compiler.is_compiling()
        # A compiled graph is made for one type of _last_log, so that all compiled calls set it, and none recompiles.
        if u.requires_grad and (compiling or self._last_log is not log):
            self._last_log = log
        kept = None if report is None else outlive_transforms(report)
        if kept is not None and kept[0].dim() == 2 and not compiling:
            _C.warn_of_idle_steps(*kept[:3], self.rtol, has_controller(self), self.on_failure)
        if kept is None:
            info = None
        else:  # if nothing was solved, way_of_last_solve() would describe an earlier solve
            info = SolveInfo(*kept, log, "" if compiling or not kept[0].numel() else _C.way_of_last_solve())
        if compiling:
            if not torch.compiler.is_exporting():  # which warns of attributes that it leaves behind
                self.info = info
        else:  # past __setattr__ of modules, which takes as long as a small solve
            self.__dict__["info"] = info
            if (call := self._call_of_rollout()) is not None:
                call.info = info

    def _solve(self, u: Tensor, log: AdjointLog) -> Solution:
        """One step: u_next and its report."""
        who = type(self).__name__
        compiling = torch.compiler.is_compiling()
        if not compiling and _check.dense(who, "u", u).dim() < 2:
            raise ValueError(f"{who}: u must have shape (batch, ...), got {tuple(u.shape)}")
        u = full_precision(u)
        # No gradient reaches u through a refused sample; with on_failure="raise" there is none.
        if self.on_failure == "raise" or (compiling and not u.requires_grad):
            return self._solve_from(u, log)
        if compiling or torch_private.transforms_are_active():  # a graph takes no hook
            return self._solve_from(self._constant_where_refused(u), log)
        if not u.requires_grad:
            return self._solve_from(u, log)
        if u.is_cpu:  # looking is free, and u needs no hook unless a sample was refused
            found = self._solve_from(u, log)
            if not _C.any_nonfinite(_status_of(found)):
                return found
        # The hook sits on a view, to see the cotangent of this step alone. Gradients through a view are summed in
        # another order.
        state = u.view_as(u)
        found = self._solve_from(state, log)
        _C.block_gradients_of_failed(state, _status_of(found), self.on_failure)
        return found

    def _constant_where_refused(self, u: Tensor) -> Tensor:
        """The same as block_gradients_of_failed(), for a graph that takes no hook: it knows the samples beforehand, by
        making A(u) and b(u) once more, for a solve without iterations."""
        with torch.no_grad():
            a = as_operator(type(self).__name__, "operator(u)", self.operator(u))
            b = self._rhs_with(u, a)
            _, info = linear_solve(a, b, GMRES(0), backward="none", on_failure="return")
            refused = info.status <= _REFUSED
        return torch.where(refused.view(-1, *[1] * (u.dim() - 1)), u.detach(), u)

    def _solve_from(self, u: Tensor, log: AdjointLog) -> Solution:
        who, compiling = type(self).__name__, torch.compiler.is_compiling()
        writes = _check.writes(u)
        a = as_operator(who, "operator(u)", self.operator(u))
        b = self._rhs_with(u, a)
        if _check.writes(u) != writes:
            raise ValueError(
                f"{who}: operator or rhs changes the state u in place; it must return a new tensor and leave u as it is"
            )
        if not compiling:
            _check.dense(who, "rhs(u)", b)
        b = full_precision(b)
        if not compiling and (b.shape != u.shape or b.dtype != u.dtype):
            raise ValueError(
                f"{who}: rhs must return the shape and dtype of the state, {tuple(u.shape)} in {u.dtype}, "
                f"got {tuple(b.shape)} in {b.dtype}"
            )
        x0 = u if self.start == "state" else None
        if not compiling:
            # None where a mode or subclass in Python is to see the op
            found: Solution | None = _C.linear_solve(
                b, a.tensors, a.kind, a.shape, a.parameters, self._options_kept(), self._max_iter, log.number, x0
            )
            if found is not None:
                return found
        solution: Solution = torch.ops.prdp.linear_solve(
            b, a.tensors, a.kind, a.shape, a.parameters, False, x0, *self._packed_options(log)
        )
        return solution

    @property
    def adjoint_info(self) -> SolveInfo | None:
        """The `SolveInfo` of the last backward pass; None before the first."""
        return self._last_log.read()

    @property
    def converged(self) -> bool:
        """Whether all samples met the tolerance, or came as near as their dtype allows, in the last forward pass and in
        the last backward pass if any."""
        reports = [report for report in (self.info, self.adjoint_info) if report is not None]
        return self.info is not None and all(bool(report.solved.all()) for report in reports)


def _status_of(found: Solution) -> Tensor:
    _u, _iterations, _residual, status, _operator_applications, _floor = found
    return status


def _unknown_argument(kind: type[Stepper], unknown: Mapping[str, object]) -> str:
    parameters = (p for init in (kind.__init__, Stepper.__init__) for p in inspect.signature(init).parameters.values())
    allowed = dict.fromkeys(p.name for p in parameters if p.kind is not p.VAR_KEYWORD and p.name != "self")
    return f"{kind.__name__}: unknown argument '{next(iter(unknown))}'; allowed: {', '.join(allowed)}"
