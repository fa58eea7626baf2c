"""`Stepper`: what all steppers have in common, and the base of those that solve A(u) u_next = b(u)."""

import torch

from prdp_torch import _C, _check, operators
from prdp_torch.batching import outlive_transforms
from prdp_torch.solve import AdjointLog, AdjointLogs, SolveInfo
from prdp_torch.solvers import Kept, check_options, checkpoint_number


class Stepper(torch.nn.Module):
    """u → u_next, both (batch, channel, *shape) in float32 or float64 and of any strides, by a linear
    solve A(u) u_next = b(u). Derivatives as `linear_solve` describes them.

    Args of every stepper beside its physics:
        solver: `Jacobi`, `Chebyshev`, `SteepestDescent`, `CG`, `GMRES` or `Direct`.
        backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every: as in `linear_solve`.
        start: where the solves start: "zero", or "state", the state before the step, as the x0 of
            `linear_solve`. It saves iterations where a step changes the state little.

    Attributes:
        max_iter: K, the solver's budget; set it at any time, by hand or by a controller. A change
            costs nothing, under `torch.compile` neither.
        rtol, adjoint_rtol: the tolerances; set them at any time as well. Under `torch.compile` every new value
            compiles once more, up to `torch._dynamo.config.recompile_limit` of them.
        start: as above; set it at any time.
        info: `SolveInfo` of the last forward or rollout; None before the first.
        adjoint_info: `SolveInfo` of the last adjoint solve, or rollout of them; None before the first
            backward.

    A subclass defines `operator(u)` and, where b(u) is not the state, `rhs(u)`; `ImplicitStep` takes the two
    as functions instead.

    Raises ValueError or TypeError for arguments out of range, before any work.
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
        self.backward = backward
        self.adjoint_max_iter = adjoint_max_iter
        self.adjoint_rtol = adjoint_rtol
        self.on_failure = on_failure
        self.checkpoint_every = checkpoint_every
        self.start = start
        # A tensor, because torch.compile takes a module's plain numbers for constants.
        self._max_iter = torch.tensor(solver.max_iter)
        self._adjoint_log = AdjointLog()
        self._last_log = self._adjoint_log
        self._kept_options = Kept(_C.SolveOptions)
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
        """The states u, step(u), step(step(u)), …, `steps` steps on, the start included: (batch, steps + 1,
        channel, *shape). `info` and `adjoint_info` then hold tensors of shape (batch, steps); a failure says
        in which step, counted from 1. Each step is a node of autograd and keeps what a single one keeps."""
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
            report = [u.new_empty((len(u), 0), dtype=t) for t in (torch.int64, u.dtype, torch.int64, torch.int64)]
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
        a = operators.as_operator(who, "operator(u)", self.operator(u))
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
        return self._kept_options.of(
            self.method,
            self.rtol,
            self.restart,
            self.backward,
            self.adjoint_max_iter,
            self.adjoint_rtol,
            self.on_failure,
            checkpoint_number(self.checkpoint_every),
            self.start == "state",
        )

    def _options(self, log_number):
        return (
            self.method,
            self._max_iter.item(),
            self.rtol,
            self.restart,
            self.backward,
            self.adjoint_max_iter,
            self.adjoint_rtol,
            self.on_failure,
            log_number,
            checkpoint_number(self.checkpoint_every),
        )

    @property
    def max_iter(self):
        return int(self._max_iter)

    @max_iter.setter
    def max_iter(self, k):
        who = type(self).__name__
        _C.check_solver(who, self.method, _check.whole(who, "max_iter", k), self.rtol, self.restart)
        self._max_iter.fill_(k)

    @property
    def adjoint_info(self):
        return self._last_log.read()

    @property
    def converged(self):
        """Whether all samples of the last forward met rtol, and of the last adjoint solve if any."""
        reports = [report for report in (self.info, self.adjoint_info) if report is not None]
        return self.info is not None and all(bool((report.status > 0).all()) for report in reports)

    def extra_repr(self):
        return f"solver={self.method}, max_iter={self.max_iter}, rtol={self.rtol:g}, backward={self.backward}"
