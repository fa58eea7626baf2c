"""Steppers of built-in equations: one time step, or one elliptic solve, as an `nn.Module`."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

import torch
from torch import Tensor

from prdp_torch import _C, _check, operators, torch_private
from prdp_torch.calls import forgets_if_it_raises
from prdp_torch.held_tensors import HoldsTensors
from prdp_torch.kept_objects import Kept
from prdp_torch.operators.base import real_tensor
from prdp_torch.solvers import Solver
from prdp_torch.stepper import Stepper
from prdp_torch.types import Backward, Length, Number, Shape, Solution, StepOptions


@dataclass
class Equation:
    """A discretised equation as the compiled library takes it, but for its tensors."""

    kind: str
    shape: list[int]
    parameters: list[float]
    picard_steps: int = 1


def _kept_length(length: Length) -> Length:
    return tuple(length) if isinstance(length, list) else length


class EquationStepper(HoldsTensors, Stepper):
    """A stepper of a built-in equation, whose rollout is a single operation.

    If nu is given as a Parameter, it becomes a Parameter of the module. A tensor becomes a buffer, and a number
    stays a number. nu, dt and length may be set at any time. A nu that is set later as a plain tensor, such as the
    output of a network, is for the steps that follow and no state.
    """

    kind: ClassVar[str]
    nu: Number
    equation: Equation

    def __init__(
        self,
        shape: Shape,
        solver: Solver,
        backward: Backward,
        length: Length,
        nu_and_dt: tuple[Number, float] | None = None,
        picard_steps: int = 1,
        **options: Unpack[StepOptions],
    ) -> None:
        super().__init__(solver, backward, **options)
        who = type(self).__name__
        self._refuse_own_system()
        extents = _check.shape(who, shape)
        self._length = _kept_length(length)
        parameters = _check.lengths(who, length, len(extents))
        self._number: tuple[float, Tensor] | None = None  # nu as a number, and as the tensor that the library takes
        if nu_and_dt is not None:
            nu, dt = nu_and_dt
            self._hold("nu", self._checked_nu(nu))
            parameters.insert(0, _check.real(who, "dt", dt))
        self.equation = Equation(self.kind, extents, parameters, _check.whole(who, "picard_steps", picard_steps))
        self._kept_equation = Kept(_C.Equation)
        self._change()

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.equation.shape)

    @shape.setter
    def shape(self, shape: Shape) -> None:
        if tuple(shape) != self.shape:
            raise AttributeError(f"{type(self).__name__}: shape cannot be set later; make a new stepper")

    @property
    def length(self) -> Length:
        return self._length

    @length.setter
    def length(self, length: Length) -> None:
        dt = self.equation.parameters[: self._parameters_before_lengths]
        self._change(parameters=dt + _check.lengths(type(self).__name__, length, len(self.equation.shape)))
        self._length = _kept_length(length)

    _parameters_before_lengths: ClassVar[int] = 0  # of the equation

    def _change(self, **changed: Any) -> None:
        """Take another equation in one piece, once it is checked: other threads, and copies, have the one before."""
        e = replace(self.equation, **changed)
        torch.ops.prdp.check_equation(self._tensors(), e.kind, e.shape, e.parameters, e.picard_steps)
        self.equation = e

    if not TYPE_CHECKING:

        def __setattr__(self, name: str, value: object) -> None:
            if name == "nu" and "equation" in vars(self) and not torch.compiler.is_compiling():
                self._set("nu", self._checked_nu(value))
                self._number = None
            else:
                super().__setattr__(name, value)

    def _checked_nu(self, nu: Number) -> Number:
        return nu if isinstance(nu, torch.Tensor) else _check.real(type(self).__name__, "nu", nu)

    def _refuse_own_system(self) -> None:
        """forward calls the compiled library, not operator(u) and rhs(u) of a subclass."""
        base = next(c for c in type(self).__mro__ if c.__module__ == __name__)
        for name in ("operator", "rhs"):
            if getattr(type(self), name) is not getattr(base, name) and type(self).forward is EquationStepper.forward:
                raise TypeError(
                    f"{type(self).__name__}: the steps of {base.__name__} do not call {name}(u) of a subclass; "
                    f"build your own with ImplicitStep(operator, rhs, solver)"
                )

    @forgets_if_it_raises
    def forward(self, u: Tensor) -> Tensor:
        """Return the next state, of the shape and dtype of u, (batch, channel, *shape). Call the module instead.

        Raises ValueError or TypeError for a u that does not fit, and with on_failure="raise" `torch.linalg.LinAlgError`
        where a sample fails."""
        log, found = self._log(), None
        if not torch.compiler.is_compiling():
            _check.dense(type(self).__name__, "u", u)
            settings = self._equation_kept(), self._options_kept(), self._max_iter
            found = _C.step(u, self._tensors(), *settings, log.number)
        if found is None:
            solution: Solution = torch.ops.prdp.step(u, *self._equation(), *self._packed_options(log))
            found = solution
        self._keep(found[1:], log, found[0])
        return found[0]

    @forgets_if_it_raises
    def rollout(self, u: Tensor, steps: int) -> Tensor:
        """Repeat the step. Returns all states, u included: (batch, steps + 1, channel, *shape).

        Values and gradients equal those of single calls bit for bit. A rollout is faster: it is one operation with one
        backward pass. `info` and `adjoint_info` then hold tensors of shape (batch, steps). If a step fails, the error
        gives its number, counted from 1. The backward pass needs the states; in implicit mode `Poisson`, and `Heat`
        with a number as nu, need nothing. A module with hooks, or a forward of its own, repeats its calls."""
        if self._calls_do_more_than(EquationStepper.forward):
            return super().rollout(u, steps)
        if not torch.compiler.is_compiling():
            _check.dense(type(self).__name__, "u", u)
            steps = _check.whole("rollout", "steps", steps)
        log = self._log()
        found: Solution = torch.ops.prdp.rollout(u, *self._equation(), steps, *self._packed_options(log))
        self._keep(found[1:], log, found[0])
        return found[0]

    def _equation(self) -> tuple[list[Tensor], str, list[int], list[float], int]:
        e = self.equation
        return self._tensors(), e.kind, e.shape, e.parameters, e.picard_steps

    def _equation_kept(self) -> _C.Equation:
        e = self.equation
        return self._kept_equation.of(e.kind, tuple(e.shape), tuple(e.parameters), e.picard_steps)

    def _tensors(self) -> list[Tensor]:
        """What the operator is made of beside the state: nu as it is now."""
        nu = self._held("nu")
        if isinstance(nu, torch.Tensor):
            return [nu]
        if torch_private.modes_are_active():
            return [real_tensor(type(self).__name__, "nu", nu)]
        if self._number is None or nu != self._number[0]:
            self._number = nu, real_tensor(type(self).__name__, "nu", nu)
        return [self._number[1]]

    def rhs(self, u: Tensor) -> Tensor:
        """b(u), the right-hand side of the step from u."""
        b: Tensor = torch.ops.prdp.rhs(u, self.equation.kind, self.equation.shape, self.equation.parameters)
        return b

    def extra_repr(self) -> str:
        length = "" if self.length == 1.0 else f"length={self.length}, "
        return f"shape={tuple(self.equation.shape)}, {length}{super().extra_repr()}"


class TimeStepper(EquationStepper):
    """The base of those that make a step of dt."""

    _parameters_before_lengths = 1

    @property
    def dt(self) -> float:
        return self.equation.parameters[0]

    @dt.setter
    def dt(self, dt: float) -> None:
        self._change(parameters=[_check.real(type(self).__name__, "dt", dt), *self.equation.parameters[1:]])


class LinearisedStepper(TimeStepper):
    """The base of those that are linearised about the state."""

    def __init__(
        self,
        shape: Shape,
        nu: Number,
        dt: float,
        solver: Solver,
        backward: Backward = "implicit",
        picard_steps: int = 1,
        length: Length = 1.0,
        **options: Unpack[StepOptions],
    ) -> None:
        super().__init__(shape, solver, backward, length, (nu, dt), picard_steps, **options)

    @property
    def picard_steps(self) -> int:
        return self.equation.picard_steps

    @picard_steps.setter
    def picard_steps(self, steps: int) -> None:
        self._change(picard_steps=_check.whole(type(self).__name__, "picard_steps", steps))


class Poisson(EquationStepper):
    """Solve the Poisson equation Δu = -p with u = 0 on the boundary. Maps p to u.

    Args:
        shape: the grid of unknowns, (N,), (Ny, Nx) or (Nz, Ny, Nx).
        solver, backward and the other options: as in `Stepper`.
        length: the side of the domain, one number or one per axis in the order of `shape`; dx = length/(N + 1).

    Examples:
        >>> poisson = prdp.Poisson((30, 30), solver=prdp.CG(max_iter=100))
        >>> u = poisson(p)  # (batch, 1, 30, 30)

    Source: second-order differences (paper, appendix C.1).
    """

    kind = "poisson"

    def __init__(
        self,
        shape: Shape,
        solver: Solver,
        backward: Backward = "implicit",
        length: Length = 1.0,
        **options: Unpack[StepOptions],
    ) -> None:
        super().__init__(shape, solver, backward, length, **options)

    def _tensors(self) -> list[Tensor]:
        return []

    def operator(self, u: Tensor | None = None) -> operators.Poisson:
        """A(u) as an operator; here the same for every u."""
        return operators.Poisson(self.equation.shape, self.length)


class Heat(TimeStepper):
    """Make one implicit Euler step of the heat equation u_t = nu Δu with u = 0 on the boundary.

    It solves (I - nu dt L) u_next = u, where L is the discrete Laplacian.

    Args:
        shape: the grid of unknowns, (N,), (Ny, Nx) or (Nz, Ny, Nx).
        nu: diffusivity >= 0, length²/time; a number, or a tensor as in `operators.Heat`. A Parameter becomes one of
            the module, and another tensor a buffer.
        dt: time step > 0. The larger nu dt/dx² is, the more iterations a solve takes.
        solver, backward and the other options: as in `Stepper`.
        length: the side of the domain, one number or one per axis in the order of `shape`; dx = length/(N + 1).

    Examples:
        >>> heat = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=10))
        >>> u1 = heat(u0)  # (batch, 1, 30)

    Source: paper, appendix C.2 to C.4.
    """

    kind = "heat"

    def __init__(
        self,
        shape: Shape,
        nu: Number,
        dt: float,
        solver: Solver,
        backward: Backward = "implicit",
        length: Length = 1.0,
        **options: Unpack[StepOptions],
    ) -> None:
        super().__init__(shape, solver, backward, length, (nu, dt), **options)

    def operator(self, u: Tensor | None = None) -> operators.Heat:
        """A(u) as an operator; here the same for every u."""
        e = self.equation
        return operators.Heat(e.shape, self.nu, e.parameters[0], self.length)


class Burgers(LinearisedStepper):
    """Make one implicit Euler step of Burgers' equation u_t + (u·∇)u = nu Δu on a periodic grid.

    It solves (I + dt Γ(u) - nu dt L) u_next = u, where Γ is first-order upwind advection, linearised about the
    state u. In 1D u is (batch, 1, N). In 2D u is (batch, 2, Ny, Nx): channel 0 is the velocity along x, the last
    axis, and channel 1 the velocity along y.

    Args:
        shape: (N,) or (Ny, Nx).
        nu, dt: as in `Heat`.
        solver, backward and the other options: as in `Stepper`.
        picard_steps: how many solves one step makes. Each is linearised about the solution of the previous one.
            `info` then has the sum of their iterations, the worst status and the last residual.
        length: as in `Heat`, but dx = length/N.

    Examples:
        >>> burgers = prdp.Burgers((256,), nu=1e-3, dt=1e-2, solver=prdp.GMRES(max_iter=20))
        >>> states = burgers.rollout(u0, 50)  # (batch, 1, 256) -> (batch, 51, 1, 256)

    Source: paper, appendix C.5.
    """

    kind = "burgers"

    def operator(self, u: Tensor) -> operators.Burgers:
        """A(u) as an operator: the winds are u."""
        return operators.Burgers(u, self.nu, self.equation.parameters[0], self.length)


class NavierStokes(LinearisedStepper):
    """Make one implicit Euler step of the Navier-Stokes equations u_t + (u·∇)u + ∇p = nu Δu, ∇·u = 0.

    The grid is periodic and staggered. The step is linearised about the state, which is (batch, 3, Ny, Nx): u₁
    along x on the left face of each cell, u₂ along y on its lower face, and the pressure p of mean zero in its
    centre. The pressure of the state has no influence on the step. `operators.NavierStokes` describes A(u).

    Args:
        shape: (Ny, Nx).
        nu, dt: as in `Heat`.
        solver, backward and the other options: as in `Stepper`.
        picard_steps, length: as in `Burgers`.

    Examples:
        >>> flow = prdp.NavierStokes((48, 48), nu=1e-4, dt=0.1, solver=prdp.GMRES(max_iter=40, restart=8))
        >>> u1 = flow(u0)  # (batch, 3, 48, 48)

    Source: paper, appendix C.6.
    """

    kind = "navier_stokes"

    def operator(self, u: Tensor) -> operators.NavierStokes:
        """A(u) as an operator: the winds are the velocity of u."""
        return operators.NavierStokes(u, self.nu, self.equation.parameters[0], self.length)
