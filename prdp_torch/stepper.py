"""`Stepper`: what all steppers have in common, and the base of those that solve A(u) u_next = b(u)."""

import torch

from prdp_torch import _C, _check, operators, torch_private
from prdp_torch.batching import outlive_transforms
from prdp_torch.solve import AdjointLog, AdjointLogs, SolveInfo
from prdp_torch.solvers import (
    Kept,
    check_options,
    checkpoint_number,
    flat_preconditioner,
    solve_options,
    tensors_of,
)


class Stepper(torch.nn.Module):
    """The base of all steppers. A stepper maps a state u to the next one by solving A(u) u_next = b(u).

    States are (batch, channel, *shape) in float32 or float64, with any strides. Gradients are computed as
    `linear_solve` describes.

    The arguments below are those that every stepper takes beside its physics. A subclass defines `operator(u)`, and
    `rhs(u)` if b(u) is not the state itself. `ImplicitStep` takes the two as functions instead.

    Args:
        solver: `Jacobi`, `Chebyshev`, `SteepestDescent`, `CG`, `BiCGStab`, `GMRES` or `Direct`.
        backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every: as in `linear_solve`.
        start: where the solves start: at "zero", or at "state", the state before the step, which then is the x0 of
            `linear_solve`. This saves iterations if a step changes the state little.

    Attributes:
        max_iter: K, the maximum number of iterations. You or a controller may set it at any time. Under
            `torch.compile` this does not compile again, except for the second value.
        rtol, adjoint_rtol: the tolerances. They may be set at any time as well, but under `torch.compile`
            each new value compiles again, up to `torch._dynamo.config.recompile_limit` times.
        start: as above. It may be set at any time.
        info: the `SolveInfo` of the last forward pass or rollout; None before the first.
        adjoint_info: the `SolveInfo` of the last backward pass; None before the first.

    Raises:
        ValueError, TypeError: an argument is wrong. This is checked before any work.
    """

    def __init__(
        self,
        solver,
        backward="implicit",
        adjoint_max_iter=None,
        adjoint_rtol=None,
        on_failure="raise",
        checkpoint_every=None,
        start="zero",
    ):
        super().__init__()
        who = type(self).__name__
        if type(self).operator is Stepper.operator and type(self).forward is Stepper.forward:
            raise TypeError(
                f"{who}: a subclass of Stepper must define operator(u), and rhs(u) where b is not the state; "
                "ImplicitStep(operator, rhs, solver) takes the two as functions"
            )
        check_options(who, solver, backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every, start)
        self.method = solver.method
        self.rtol = float(solver.rtol)
        self.restart = solver.restart
        self.preconditioner = solver.preconditioner
        self.backward = backward
        self.adjoint_max_iter = adjoint_max_iter
        self.adjoint_rtol = adjoint_rtol
        self.on_failure = on_failure
        self.checkpoint_every = checkpoint_every
        self.start = start
        self._max_iter = int(solver.max_iter)
        self._adjoint_log = AdjointLog()
        self._last_log = self._adjoint_log
        self._kept_options = Kept(solve_options)
        self.info = None

    def operator(self, u):
        """A(u), an operator of `prdp_torch.operators`."""
        raise NotImplementedError(f"{type(self).__name__}: operator(u) is not defined")

    def rhs(self, u):
        """b(u), the right-hand side of the step from u."""
        return u

    def forward(self, u):
        u_next, *report = self._solve(u, self._adjoint_log)
        self._keep(report, self._adjoint_log)
        if u_next.requires_grad:
            self._last_log = self._adjoint_log
        return u_next

    def rollout(self, u, steps):
        """Repeat the step. Returns all states, u included: (batch, steps + 1, channel, *shape).

        `info` and `adjoint_info` then hold tensors of shape (batch, steps). If a step fails, the error gives its
        number, counted from 1. For the backward pass each step stores what a single step stores."""
        compiling = torch.compiler.is_compiling()
        if not compiling:
            _check.dense(type(self).__name__, "u", u)
            if _check.whole("rollout", "steps", steps) < 0:
                raise ValueError(f"rollout: steps must be >= 0, got {steps}")
        log = self._adjoint_log if compiling else AdjointLogs(steps)
        states, reports = [u], []
        for step in range(steps):
            if compiling:
                u_next, *report = self._solve(states[-1], self._adjoint_log)
            else:
                with _C.StepOfRollout(step + 1, steps):
                    u_next, *report = self._solve(states[-1], log[step])
            states.append(u_next)
            reports.append(report)
        states = torch.stack(states, 1)
        if steps > 0:
            report = [torch.stack(of_steps, 1) for of_steps in zip(*reports, strict=True)]
        else:
            report = [
                u.new_empty((len(u), 0), dtype=t) for t in (torch.int64, u.dtype, torch.int64, torch.int64, u.dtype)
            ]
        self._keep(report, log)
        # A rollout without gradients, such as a validation, leaves the report of the last backward pass.
        if states.requires_grad:
            self._last_log = log
        return states

    def _keep(self, report, log):
        report = outlive_transforms(report)
        info = None if report is None else SolveInfo(*report, log)
        if torch.compiler.is_compiling():
            self.info = info
        else:  # past __setattr__ of modules, which takes as long as a small solve
            self.__dict__["info"] = info

    def _solve(self, u, log):
        """One step: u_next and its report."""
        who = type(self).__name__
        compiling = torch.compiler.is_compiling()
        if not compiling and _check.dense(who, "u", u).dim() < 2:
            raise ValueError(f"{who}: u must have shape (batch, ...), got {tuple(u.shape)}")
        a = operators.matrix.as_operator(who, "operator(u)", self.operator(u))
        b = self.rhs(u)
        if not compiling:
            _check.dense(who, "rhs(u)", b)
            if b.shape != u.shape or b.dtype != u.dtype:
                raise ValueError(
                    f"{who}: rhs must return the shape and dtype of the state, {tuple(u.shape)} in {u.dtype}, "
                    f"got {tuple(b.shape)} in {b.dtype}"
                )
        x0 = u if self.start == "state" else None
        if not compiling:
            found = _C.linear_solve(
                b, a.tensors, a.kind, a.shape, a.parameters, self._options_kept(), self._max_iter, log.number, x0
            )
            if found is not None:
                return found
        return torch.ops.prdp.linear_solve(
            b, a.tensors, a.kind, a.shape, a.parameters, False, *self._options(log.number), x0
        )

    def _options_kept(self):
        """The options as the compiled library takes them past the dispatcher."""
        solver = self.method, self.rtol, self.restart, self.preconditioner, tensors_of(self.preconditioner)
        every = checkpoint_number(self.checkpoint_every)
        return self._kept_options.of(*solver, *self._settings(), every, self.start == "state")

    def _options(self, log_number):
        compiling = torch.compiler.is_dynamo_compiling()
        k = torch_private.number_as_graph_input(self, "_max_iter") if compiling else self._max_iter
        solver = self.method, k, self.rtol, self.restart, *flat_preconditioner(self.preconditioner)
        return *solver, *self._settings(), log_number, checkpoint_number(self.checkpoint_every)

    def _settings(self):
        return self.backward, self.adjoint_max_iter, self.adjoint_rtol, self.on_failure

    @property
    def max_iter(self):
        return self._max_iter

    @max_iter.setter
    def max_iter(self, k):
        who = type(self).__name__
        _C.check_solver(who, self.method, _check.whole(who, "max_iter", k), self.rtol, self.restart)
        self._max_iter = int(k)

    @property
    def start(self):
        return self._start

    @start.setter
    def start(self, start):
        _C.check_start(_check.string(type(self).__name__, "start", start))
        self._start = start

    @property
    def adjoint_info(self):
        return self._last_log.read()

    @property
    def converged(self):
        """Whether all samples met the tolerance, or came as near as their dtype allows, in the last forward pass and in
        the last backward pass if any."""
        reports = [report for report in (self.info, self.adjoint_info) if report is not None]
        return self.info is not None and all(bool(report.solved.all()) for report in reports)

    def extra_repr(self):
        by = (
            ""
            if self.preconditioner is None or self.method == "multigrid"
            else f", preconditioner={self.preconditioner!r}"
        )
        return f"solver={self.method}{by}, max_iter={self.max_iter}, rtol={self.rtol:g}, backward={self.backward}"
