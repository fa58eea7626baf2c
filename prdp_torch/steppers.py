"""Steppers: one time step, or one elliptic solve, as an `nn.Module` without weights."""

from dataclasses import dataclass

import torch

from prdp_torch import _C, _check, operators
from prdp_torch.solve import AdjointLog, SolveInfo
from prdp_torch.solvers import check_options, checkpoint_number


@dataclass
class Equation:
    """A discretised equation as the compiled library takes it."""

    kind: str
    shape: list
    parameters: list
    tensors: list
    picard_steps: int = 1

    def __post_init__(self):
        torch.ops.prdp.check_equation(self.tensors, self.kind, self.shape, self.parameters, self.picard_steps)

    @classmethod
    def implicit_step(cls, who, kind, shape, nu, dt, picard_steps=1):
        """One implicit Euler step with diffusion; types in words."""
        return cls(
            kind,
            _check.shape(who, shape),
            [_check.real(who, "dt", dt)],
            [operators.real_tensor(who, "nu", nu)],
            _check.whole(who, "picard_steps", picard_steps),
        )


class Stepper(torch.nn.Module):
    """u → u_next, both (batch, channel, *shape) in float32 or float64 and of any strides, by a linear
    solve A(u) u_next = b(u) that starts from zero. Derivatives as `linear_solve` describes them.

    Args of every stepper beside its physics:
        shape: grid of unknowns in the unit domain, (N,), (Ny, Nx) or (Nz, Ny, Nx).
        solver: `Jacobi`, `Chebyshev`, `SteepestDescent`, `CG`, `GMRES` or `Direct`.
        backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every: as in `linear_solve`.

    Attributes:
        max_iter: K, the solver's budget; set it at any time, by hand or by a controller. A change
            costs nothing, under `torch.compile` neither.
        rtol, adjoint_rtol: the tolerances; set them at any time as well. Under `torch.compile` every new value
            compiles once more, up to `torch._dynamo.config.recompile_limit` of them.
        info: `SolveInfo` of the last forward or rollout; None before the first.
        adjoint_info: `SolveInfo` of the last adjoint solve, or rollout of them; None before the first
            backward.

    Raises ValueError or TypeError for arguments out of range, before any work.
    """

    def __init__(
        self,
        equation,
        solver,
        backward="implicit",
        adjoint_max_iter=None,
        adjoint_rtol=None,
        on_failure="raise",
        checkpoint_every=None,
    ):
        super().__init__()
        who = type(self).__name__
        check_options(who, solver, backward, adjoint_max_iter, adjoint_rtol, on_failure, checkpoint_every)
        self.equation = equation
        self.method = solver.method
        self.rtol = float(solver.rtol)
        self.restart = solver.restart
        self.backward = backward
        self.adjoint_max_iter = adjoint_max_iter
        self.adjoint_rtol = adjoint_rtol
        self.on_failure = on_failure
        self.checkpoint_every = checkpoint_every
        # A tensor, because torch.compile takes a module's plain numbers for constants.
        self._max_iter = torch.tensor(solver.max_iter)
        self._adjoint_log = AdjointLog()
        self.info = None

    def forward(self, u):
        if not torch.compiler.is_compiling():
            _check.dense(type(self).__name__, "u", u)
        u_next, *report = torch.ops.prdp.step(u, *self._equation(), *self._options())
        self.info = SolveInfo(*report, self._adjoint_log)
        return u_next

    def rollout(self, u, steps):
        """The states u, step(u), step(step(u)), …, `steps` steps on, the start included: (batch, steps + 1,
        channel, *shape). The same values and gradients as by calling the stepper, to the last bit, but in
        one op with one backward pass, which saves the fixed cost of a call and of its node in every step.
        `info` and `adjoint_info` then hold tensors of shape (batch, steps); a failure says in which step,
        counted from 1. Kept for the backward pass are the states (nothing for `Poisson`, or `Heat` with a
        plain nu, in implicit mode)."""
        if not torch.compiler.is_compiling():
            _check.dense(type(self).__name__, "u", u)
            steps = _check.whole("rollout", "steps", steps)
        states, *report = torch.ops.prdp.rollout(u, *self._equation(), steps, *self._options())
        self.info = SolveInfo(*report, self._adjoint_log)
        return states

    def _equation(self):
        e = self.equation
        return e.tensors, e.kind, e.shape, e.parameters, e.picard_steps

    def _options(self):
        return (
            self.method,
            self._max_iter.item(),
            self.rtol,
            self.restart,
            self.backward,
            self.adjoint_max_iter,
            self.adjoint_rtol,
            self.on_failure,
            self._adjoint_log.number,
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
        return self._adjoint_log.read()

    @property
    def converged(self):
        """Whether all samples of the last forward met rtol, and of the last adjoint solve if any."""
        reports = [report for report in (self.info, self.adjoint_info) if report is not None]
        return self.info is not None and all(bool((report.status > 0).all()) for report in reports)

    def rhs(self, u):
        """b(u), the right-hand side of the step from u."""
        return torch.ops.prdp.rhs(u, self.equation.kind, self.equation.shape, self.equation.parameters)

    def extra_repr(self):
        e = self.equation
        return (
            f"shape={tuple(e.shape)}, solver={self.method}, max_iter={self.max_iter}, rtol={self.rtol:g}, "
            f"backward={self.backward}"
        )


class Poisson(Stepper):
    """Δu = -p with u = 0 on the boundary of the unit domain; maps p to u. `shape` unknowns,
    dx = 1/(N + 1), second-order differences (paper, appendix C.1)."""

    def __init__(self, shape, solver, backward="implicit", **options):
        super().__init__(Equation("poisson", _check.shape("Poisson", shape), [], []), solver, backward, **options)

    def operator(self, u=None):
        """A(u) as an operator; here the same for every u."""
        return operators.Poisson(self.equation.shape)


class Heat(Stepper):
    """One implicit Euler step of u_t = nu Δu with u = 0 on the boundary of the unit domain:
    (I - nu dt L) u_next = u, `shape` unknowns, dx = 1/(N + 1) (paper, appendix C.2 to C.4).

    nu >= 0 (length²/time, the domain's side being 1), a number or a 0-dimensional tensor, which then
    gets a gradient; dt > 0 (time). Only nu dt/dx² matters: Jacobi's iteration count grows with it.
    """

    def __init__(self, shape, nu, dt, solver, backward="implicit", **options):
        super().__init__(Equation.implicit_step("Heat", "heat", shape, nu, dt), solver, backward, **options)

    def operator(self, u=None):
        """A(u) as an operator; here the same for every u."""
        e = self.equation
        return operators.Heat(e.shape, e.tensors[0], e.parameters[0])


class Burgers(Stepper):
    """One implicit Euler step of u_t + (u·∇)u = nu Δu on a periodic grid of the unit domain, dx = 1/N:
    (I + dt Γ(u) - nu dt L) u_next = u, first-order upwind, linearised about the state u (paper, appendix
    C.5). shape (N,) with u of (batch, 1, N), or (Ny, Nx) with u of (batch, 2, Ny, Nx): channel 0 is the
    velocity along x, the last axis, channel 1 along y.

    nu >= 0 (length²/time), a number or a 0-dimensional tensor, which then gets a gradient; dt > 0.
    picard_steps: solves a step, each linearised about the solution of the one before; `info` then counts
    all their iterations and holds the worst status and the last residual.
    """

    def __init__(self, shape, nu, dt, solver, backward="implicit", picard_steps=1, **options):
        equation = Equation.implicit_step("Burgers", "burgers", shape, nu, dt, picard_steps)
        super().__init__(equation, solver, backward, **options)

    def operator(self, u):
        """A(u) as an operator: the winds are u."""
        return operators.Burgers(u, self.equation.tensors[0], self.equation.parameters[0])


class NavierStokes(Stepper):
    """One implicit Euler step of u_t + (u·∇)u + ∇p = nu Δu with ∇·u = 0 on a periodic staggered grid
    (Ny, Nx) of the unit square, dx = 1/N, linearised about the state (paper, appendix C.6). The state is
    (batch, 3, Ny, Nx): u₁ along x on the left face of a cell, u₂ along y on its lower face, p of mean
    zero in its centre; the step does not depend on its pressure. `operators.NavierStokes` is A(u).

    nu, dt, picard_steps: as in `Burgers`.
    """

    def __init__(self, shape, nu, dt, solver, backward="implicit", picard_steps=1, **options):
        equation = Equation.implicit_step("NavierStokes", "navier_stokes", shape, nu, dt, picard_steps)
        super().__init__(equation, solver, backward, **options)

    def operator(self, u):
        """A(u) as an operator: the winds are the velocity of u."""
        return operators.NavierStokes(u, self.equation.tensors[0], self.equation.parameters[0])
