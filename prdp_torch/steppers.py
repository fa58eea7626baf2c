"""Steppers of built-in equations: one time step, or one elliptic solve, as an `nn.Module`."""

from dataclasses import dataclass

import torch

from prdp_torch import _C, _check, operators
from prdp_torch.solvers import Kept
from prdp_torch.stepper import Stepper


@dataclass
class Equation:
    """A discretised equation as the compiled library takes it, but for its tensors."""

    kind: str
    shape: list
    parameters: list
    picard_steps: int = 1


class EquationStepper(Stepper):
    """A stepper whose equation the compiled library knows, so that a rollout is one op.

    nu is a Parameter of the module where it was given as one, a buffer where it was given as a tensor, and
    a plain number else.
    """

    def __init__(self, shape, solver, backward, length, nu_and_dt=None, picard_steps=1, **options):
        super().__init__(solver, backward, **options)
        who = type(self).__name__
        self._refuse_own_system()
        shape = _check.shape(who, shape)
        self.length = length
        parameters = _check.lengths(who, length, len(shape))
        if nu_and_dt is not None:
            nu, dt = nu_and_dt
            self._keep_nu(nu)
            parameters.insert(0, _check.real(who, "dt", dt))
        self.equation = Equation(self.kind, shape, parameters, _check.whole(who, "picard_steps", picard_steps))
        self._kept_equation = Kept(_C.Equation)
        torch.ops.prdp.check_equation(*self._equation())

    def _keep_nu(self, nu):
        if isinstance(nu, torch.nn.Parameter):
            self.nu = nu
        elif isinstance(nu, torch.Tensor):
            self.register_buffer("nu", nu)
        else:
            self.nu = _check.real(type(self).__name__, "nu", nu)
        self._number = None, None  # nu as a number, and as the tensor that the library takes

    def _refuse_own_system(self):
        """forward calls the compiled library, not operator(u) and rhs(u) of a subclass."""
        base = next(c for c in type(self).__mro__ if c.__module__ == __name__)
        for name in ("operator", "rhs"):
            if getattr(type(self), name) is not getattr(base, name) and type(self).forward is EquationStepper.forward:
                raise TypeError(
                    f"{type(self).__name__}: the steps of {base.__name__} do not call {name}(u) of a subclass; "
                    f"build your own with ImplicitStep(operator, rhs, solver)"
                )

    def forward(self, u):
        found = None
        if not torch.compiler.is_compiling():
            _check.dense(type(self).__name__, "u", u)
            log = self._adjoint_log.number
            found = _C.step(u, self._tensors(), self._equation_kept(), self._options_kept(), self._max_iter, log)
        if found is None:
            found = torch.ops.prdp.step(u, *self._equation(), *self._step_options())
        u_next, *report = found
        self._keep(report, self._adjoint_log)
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
        states, *report = torch.ops.prdp.rollout(u, *self._equation(), steps, *self._step_options())
        self._keep(report, self._adjoint_log)
        return states

    def _equation(self):
        e = self.equation
        return self._tensors(), e.kind, e.shape, e.parameters, e.picard_steps

    def _equation_kept(self):
        e = self.equation
        return self._kept_equation.of(e.kind, tuple(e.shape), tuple(e.parameters), e.picard_steps)

    def _step_options(self):
        return *self._options(self._adjoint_log.number), self.start == "state"

    def _tensors(self):
        """What the operator is made of beside the state: nu as it is now."""
        nu = self.nu
        if isinstance(nu, torch.Tensor):
            return [nu]
        number, tensor = self._number
        if nu != number:
            tensor = operators.real_tensor(type(self).__name__, "nu", nu)
            self._number = nu, tensor
        return [tensor]

    def rhs(self, u):
        """b(u), the right-hand side of the step from u."""
        return torch.ops.prdp.rhs(u, self.equation.kind, self.equation.shape, self.equation.parameters)

    def extra_repr(self):
        length = "" if self.length == 1.0 else f"length={self.length}, "
        return f"shape={tuple(self.equation.shape)}, {length}{super().extra_repr()}"


class Poisson(EquationStepper):
    """Δu = -p with u = 0 on the boundary; maps p to u. Second-order differences (paper, appendix C.1).

    shape: the grid of unknowns, (N,), (Ny, Nx) or (Nz, Ny, Nx).
    length: the side of the domain, one number or one per axis in the order of `shape`; dx = length/(N + 1).
    """

    kind = "poisson"

    def __init__(self, shape, solver, backward="implicit", length=1.0, **options):
        super().__init__(shape, solver, backward, length, **options)

    def _tensors(self):
        return []

    def operator(self, u=None):
        """A(u) as an operator; here the same for every u."""
        return operators.Poisson(self.equation.shape, self.length)


class Heat(EquationStepper):
    """One implicit Euler step of u_t = nu Δu with u = 0 on the boundary: (I - nu dt L) u_next = u (paper,
    appendix C.2 to C.4).

    nu: >= 0 (length²/time), a number or a 0-dimensional tensor, which then gets a gradient; a Parameter is
        the module's (in `parameters()`), another tensor a buffer of it.
    dt: > 0 (time). Only nu dt/dx² matters: Jacobi's iteration count grows with it.
    shape: the grid of unknowns, (N,), (Ny, Nx) or (Nz, Ny, Nx).
    length: the side of the domain, one number or one per axis in the order of `shape`; dx = length/(N + 1).
    """

    kind = "heat"

    def __init__(self, shape, nu, dt, solver, backward="implicit", length=1.0, **options):
        super().__init__(shape, solver, backward, length, (nu, dt), **options)

    def operator(self, u=None):
        """A(u) as an operator; here the same for every u."""
        e = self.equation
        return operators.Heat(e.shape, self.nu, e.parameters[0], self.length)


class Burgers(EquationStepper):
    """One implicit Euler step of u_t + (u·∇)u = nu Δu on a periodic grid, dx = length/N:
    (I + dt Γ(u) - nu dt L) u_next = u, first-order upwind, linearised about the state u (paper, appendix
    C.5). shape (N,) with u of (batch, 1, N), or (Ny, Nx) with u of (batch, 2, Ny, Nx): channel 0 is the
    velocity along x, the last axis, channel 1 along y.

    nu, dt, length: as in `Heat`.
    picard_steps: solves a step, each linearised about the solution of the one before; `info` then counts
    all their iterations and holds the worst status and the last residual.
    """

    kind = "burgers"

    def __init__(self, shape, nu, dt, solver, backward="implicit", picard_steps=1, length=1.0, **options):
        super().__init__(shape, solver, backward, length, (nu, dt), picard_steps, **options)

    def operator(self, u):
        """A(u) as an operator: the winds are u."""
        return operators.Burgers(u, self.nu, self.equation.parameters[0], self.length)


class NavierStokes(EquationStepper):
    """One implicit Euler step of u_t + (u·∇)u + ∇p = nu Δu with ∇·u = 0 on a periodic staggered grid
    (Ny, Nx), dx = length/N, linearised about the state (paper, appendix C.6). The state is
    (batch, 3, Ny, Nx): u₁ along x on the left face of a cell, u₂ along y on its lower face, p of mean
    zero in its centre; the step does not depend on its pressure. `operators.NavierStokes` is A(u).

    nu, dt, length: as in `Heat`; picard_steps: as in `Burgers`.
    """

    kind = "navier_stokes"

    def __init__(self, shape, nu, dt, solver, backward="implicit", picard_steps=1, length=1.0, **options):
        super().__init__(shape, solver, backward, length, (nu, dt), picard_steps, **options)

    def operator(self, u):
        """A(u) as an operator: the winds are the velocity of u."""
        return operators.NavierStokes(u, self.nu, self.equation.parameters[0], self.length)
