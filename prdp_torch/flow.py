"""`Flow`: incompressible flow by projection."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, Unpack

import torch
from torch import Tensor

from prdp_torch import _C, _check, flow_walls
from prdp_torch.calls import forgets_if_it_raises, not_in_graphs
from prdp_torch.flow_walls import Side, WallVelocity
from prdp_torch.held_tensors import HoldsTensors
from prdp_torch.kept_objects import Kept
from prdp_torch.operators.base import full_precision, kept_numbers, real_tensor
from prdp_torch.solvers import CG, Solver
from prdp_torch.stepper import Stepper
from prdp_torch.types import Backward, Length, Number, Shape, Solution, Start, StepOptions

Boundary: TypeAlias = Literal["periodic", "wall", "slip", "open"]
VECTORS = {"force", "inflow"}
# What may be set for the next steps.
TENSORS = {"nu", *VECTORS, *flow_walls.NAMES.values()}


class Flow(HoldsTensors, Stepper):
    """Make one time step of incompressible flow, u_t + (u·∇)u + ∇p = nu Δu + force with ∇·u = 0, in 2D or 3D.

    The state u is (batch, d, *shape). The grid is staggered: channel 0 is the velocity along x, the last axis, and each
    component lies on the low face of its own axis. One step advects by explicit Euler, diffuses, and then projects the
    velocity onto the ones without divergence. The projection solves an equation for the pressure.

    Args:
        shape: the cells, (Ny, Nx) or (Nz, Ny, Nx), at least 3 per axis.
        nu: viscosity >= 0, length²/time: a number or a tensor, which gets a gradient: 0-dimensional, or
            (batch or 1,), one for each sample. A Parameter becomes one of the module, and another tensor a buffer. The
            same holds for `force`, `inflow` and `wall_velocity`.
        dt: time step > 0. dt Σ |u|/dx may be at most 1; with central advection and implicit diffusion at most
            max(1, √(2 nu dt)/dx) for the largest dx; with upwind advection and explicit diffusion at most
            1 - nu dt Σ 2/dx². A longer step raises an error.
        boundary: one for all axes, or one per axis in the order of `shape`.
            "periodic".
            "wall": no slip at both ends. The low face of the first cell lies on the wall.
            "slip": the same without friction, as at a plane of symmetry or a calm surface.
            "open": `inflow` at the low end; at the high end pressure zero and no normal gradient. At most one axis.
        length: the side of the domain, one number or one per axis in the order of `shape`; dx = length/N.
        obstacle: bool (*shape), or (batch or 1, *shape) for one of each sample, True in solid cells. Their faces carry
            no velocity.
        force: acceleration, (d,) or (batch or 1, d, *shape).
        inflow: velocity at the low end of the open axis, (d,), or (batch or 1, d, *shape) with extent 1 along it.
        wall_velocity: the velocity of walls that move along themselves: a dict from a side, such as (0, "high"), to a
            number (in 2D), (d,), or (batch or 1, d, *side), where side is shape without the axis. The component through
            the wall must be 0.
        advection: "central" is of second order and conserves the energy; it needs about dt <= 2 nu/|u|². "upwind" is of
            first order and stable without viscosity.
        diffusion: "implicit" solves with `solver`, and "explicit" needs nu dt Σ 2/dx² <= 1.
        pressure: "incremental" takes the pressure of all forces off before the implicit diffusion, by one more solve.
            Steady flows then do not depend on dt, up to nu dt/dx² = 4, with an obstacle 1.25 in 2D and 0.6 in 3D.
            "plain" leaves the pressure to the projection after it. The two are the same with explicit diffusion, and
            in a periodic box without obstacle.
        solver: for the pressure and the implicit diffusion, both symmetric. CG(100) with multigrid by default.
        backward and the other options: as in `Stepper`, but `start` must be "zero".

    All but `shape` may be set at any time, `pressure` by the name `pressure_form`. A tensor that is set later as `nu`,
    `force`, `inflow` or `wall_velocity`, such as the output of a network, or as obstacles of samples, is used in the
    steps that follow but not saved: copies and `state_dict` keep the earlier value. Parameters, buffers, an obstacle
    of all samples and what a flow is made of are saved; plain numbers go into copies, not into `state_dict`.

    `info` combines the solves of a step: it has the sum of their iterations, the worst status and the largest residual.
    Each step stores one state for the backward pass, and computes the rest again.

    Raises:
        ValueError, TypeError: an argument is wrong. This is checked before any work.
        torch.linalg.LinAlgError: a sample failed; a step that is too long has status DIVERGED.

    Examples:
        >>> flow = prdp.Flow((64, 64), nu=1e-3, dt=1e-2)
        >>> states = flow.rollout(flow.project(u0), 50)  # (batch, 2, 64, 64) -> (batch, 51, 2, 64, 64)
        >>> channel = prdp.Flow((24, 96), nu=1e-2, dt=1e-2, boundary=("wall", "open"), length=(1, 4), inflow=profile)
        >>> cavity = prdp.Flow((64, 64), nu=1e-2, dt=1e-2, boundary="wall", wall_velocity={(0, "high"): 1.0})

    Source: Harlow and Welch (1965) for the grid, Chorin (1968) for the step, Guermond, Minev and Shen (2006) for the
    forms of the pressure.
    """

    shape: tuple[int, ...]
    dt: float
    boundary: Boundary | Sequence[Boundary]
    length: Length
    advection: str
    diffusion: str
    pressure_form: str
    nu: Number
    force: Tensor | None
    inflow: Tensor | None
    obstacle: Tensor | None

    def __init__(
        self,
        shape: Shape,
        nu: Number,
        dt: float,
        boundary: Boundary | Sequence[Boundary] = "periodic",
        length: Length = 1.0,
        obstacle: Tensor | None = None,
        force: Tensor | Sequence[float] | None = None,
        inflow: Tensor | Sequence[float] | None = None,
        advection: Literal["central", "upwind"] = "central",
        diffusion: Literal["implicit", "explicit"] = "implicit",
        solver: Solver | None = None,
        backward: Backward = "implicit",
        wall_velocity: WallVelocity | None = None,
        pressure: Literal["incremental", "plain"] = "incremental",
        **options: Unpack[StepOptions],
    ) -> None:
        solver = CG(max_iter=100, preconditioner="multigrid") if solver is None else solver
        super().__init__(solver, backward, **options)
        self.shape = tuple(_check.shape("Flow", shape))
        self.dt = _check.real("Flow", "dt", dt)
        self.boundary, self.length = boundary, length
        self.advection = _check.string("Flow", "advection", advection)
        self.diffusion = _check.string("Flow", "diffusion", diffusion)
        self.pressure_form = _check.string("Flow", "pressure", pressure)
        self._hold("nu", nu if isinstance(nu, Tensor) else _check.real("Flow", "nu", nu))
        walls = flow_walls.by_name(wall_velocity, len(self.shape))
        for name, given in {"force": force, "inflow": inflow, **walls}.items():
            numbers = name in VECTORS and given is not None and not isinstance(given, Tensor)
            self._hold(name, _of_numbers(name, given) if numbers else _checked(name, given))
        self.register_buffer("obstacle", obstacle if obstacle is None else _check.dense("Flow", "obstacle", obstacle))
        self._kept_box = Kept(_make_box)
        self._equation().check()

    if not TYPE_CHECKING:

        def __setattr__(self, name: str, value: object) -> None:
            if isinstance(value, Tensor) and name in TENSORS:
                self._set(name, _checked(name, value))
            elif name in TENSORS:
                self._hold(name, _checked(name, value))
            elif name == "obstacle" and (value is None or isinstance(value, Tensor)):
                of_samples = isinstance(value, Tensor) and value.dim() > len(self.shape) and len(value) != 1
                (self._set if of_samples else self._hold)(name, value)
            elif name == "pressure":
                raise AttributeError("Flow: pressure is a method; the form of the argument is set by pressure_form")
            else:
                super().__setattr__(name, value)

    @property
    def wall_velocity(self) -> Mapping[Side, Tensor]:
        """The velocity of each wall that was given one, by its side, such as (0, "high")."""
        places: tuple[dict[str, Any], ...] = self.__dict__, self._parameters, self._buffers
        values: dict[Side, Tensor] = {}
        for side, name in flow_walls.NAMES.items():
            velocity = next((place[name] for place in places if place.get(name) is not None), None)
            if velocity is not None:
                values[side] = velocity
        return MappingProxyType(values)

    @wall_velocity.setter
    def wall_velocity(self, given: WallVelocity | None) -> None:
        for name, value in flow_walls.by_name(given, len(self.shape)).items():
            setattr(self, name, value)

    @property
    def start(self) -> Start:
        """Always "zero": the solves are for changes."""
        return "zero"

    @start.setter
    def start(self, start: Start) -> None:
        if start != "zero":
            raise ValueError(f"Flow: start must be 'zero': its solves are for changes, got {start!r}")

    @not_in_graphs
    @forgets_if_it_raises
    def forward(self, u: Tensor) -> Tensor:
        """Return the velocity after one step, of the shape and dtype of u, (batch, d, *shape). Call the module instead.

        Raises ValueError or TypeError for a u that does not fit, and with on_failure="raise" `torch.linalg.LinAlgError`
        where a sample fails, as in a step that is too long."""
        u = _field("Flow", "u", u)
        log = self._log()
        found: Solution = self._equation().step(u, self._options_kept(), self._max_iter, log.number)
        self._keep(found[1:], log, found[0])
        return found[0]

    @not_in_graphs
    @forgets_if_it_raises
    def step_and_pressure(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return the next state, (batch, d, *shape), and the `pressure` of the step, (batch, 1, *shape), by one step.
        Its gradient takes one adjoint step. Raises as `forward`."""
        u = _field("Flow", "u", u)
        log = self._log()
        found: Solution = self._equation().step_and_pressure(u, self._options_kept(), self._max_iter, log.number)
        self._keep(found[1:], log, found[0])
        d = len(self.shape)
        return found[0][:, :d], found[0][:, d:]

    @not_in_graphs
    @forgets_if_it_raises
    def rollout(self, u: Tensor, steps: int) -> Tensor:
        """Repeat the step. Returns all states, u included: (batch, steps + 1, d, *shape).

        It is a single node of autograd, whose backward pass needs the states alone. `info` and `adjoint_info` then hold
        tensors of shape (batch, steps). If a step fails, the error gives its number, counted from 1. Where a subclass
        has a forward of its own, or there are hooks, it repeats the calls of the module."""
        if self._calls_do_more_than(Flow.forward):
            return super().rollout(u, steps)
        u = _field("Flow", "u", u)
        steps = _check.whole("rollout", "steps", steps)
        log = self._log()
        found: Solution = self._equation().rollout(u, steps, self._options_kept(), self._max_iter, log.number)
        self._keep(found[1:], log, found[0])
        return found[0]

    @not_in_graphs
    def project(self, u: Tensor) -> Tensor:
        """Return the velocity nearest to u, (batch, d, *shape), with the boundary values and without divergence.
        `info` stays that of the last step. Raises as `forward`; where on_failure lets NaN in u pass, it remains."""
        return self._equation().project(_field("Flow", "u", u), self._options_kept(), self._max_iter)

    @not_in_graphs
    def pressure(self, u: Tensor) -> Tensor:
        """Return the pressure of the step from u, (batch, 1, *shape). It is zero inside obstacles, and its mean is zero
        unless an axis is open. `info` stays that of the last step. Raises as `forward`."""
        return self._equation().pressure(_field("Flow", "u", u), self._options_kept(), self._max_iter)

    @not_in_graphs
    def divergence(self, u: Tensor) -> Tensor:
        """Return ∇·u of u with the boundary values, (batch, 1, *shape). It is zero in solid cells, and in the last
        cells before an open end, whose high faces take what mass conservation gives. NaN in u remains."""
        return self._equation().divergence(_field("Flow", "u", u))

    def fill_pockets(self, obstacle: Tensor) -> Tensor:
        """Return an obstacle, bool (*shape) or (batch, *shape), with the fluid filled that nothing flows through: all
        but its largest connected part or, with an open axis, the parts that join its two ends. Such pockets take time,
        and at an open end a `Flow` refuses them. Raises ValueError or TypeError for another shape or dtype, or where
        no fluid is left."""
        d = len(self.shape)
        box = _C.FlowBox(list(self.shape), list(_of_axes("boundary", self.boundary, d)), [1.0] * d, None)
        return box.fill_pockets(_check.dense("Flow", "obstacle", obstacle))

    def _equation(self) -> _C.FlowEquation:
        nu, dt = full_precision(real_tensor("Flow", "nu", self.nu)), _check.real("Flow", "dt", self.dt)
        force = _check.optional(_field, "Flow", "force", self.force)
        inflow = _check.optional(_field, "Flow", "inflow", self.inflow)
        d = len(self.shape)
        moving = self.wall_velocity
        walls = flow_walls.vectors(moving, d) if moving else []
        boundary, length = _of_axes("boundary", self.boundary, d), _of_axes("length", self.length, d)
        if not all(isinstance(name, str) for name in boundary):
            names = '"periodic", "wall", "slip" or "open"'
            raise TypeError(f"Flow: boundary must be {names}, or one of them per axis, got {self.boundary!r}")
        sides = tuple(_check.real("Flow", "length", side) for side in length)
        box = self._kept_box.of(tuple(self.shape), boundary, sides, _Mask(self.obstacle))
        return _C.FlowEquation(box, dt, nu, force, inflow, walls, self.advection, self.diffusion, self.pressure_form)

    def extra_repr(self) -> str:
        obstacle = "" if self.obstacle is None else f"obstacle={tuple(self.obstacle.shape)}, "
        return f"shape={self.shape}, dt={self.dt:g}, boundary={self.boundary}, {obstacle}{super().extra_repr()}"


def _checked(name: str, value: object) -> object:
    """What may be set, with the numbers of a vector as a tensor."""
    if isinstance(value, Tensor):
        return _check.dense("Flow", name, value)
    return _of_numbers(name, value) if isinstance(value, (tuple, list)) else value


def _field(who: str, name: str, value: object) -> Tensor:
    return full_precision(_check.dense(who, name, value))


class _Mask:
    """An obstacle, which equals another one if it is solid in the same cells. What is written through .data or NumPy
    leaves no trace but the values."""

    def __init__(self, obstacle: Tensor | None) -> None:
        self.obstacle = obstacle

    def keep(self) -> None:
        """Hold the values of now, whatever is written later."""
        self.obstacle = None if self.obstacle is None else self.obstacle.clone()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Mask) or self.obstacle is None or other.obstacle is None:
            return isinstance(other, _Mask) and self.obstacle is other.obstacle
        a, b = self.obstacle, other.obstacle
        if a.shape != b.shape or a.dtype != torch.bool or a.dtype != b.dtype or a.device != b.device:
            return False
        pairs = zip(_words(a), _words(b), strict=True)
        return all(torch.equal(*pair) for pair in pairs)


def _words(mask: Tensor) -> tuple[Tensor, Tensor]:
    """Eight cells at once, which are compared as fast as one; and the last cells."""
    flat = mask.flatten()
    flat = flat.clone() if flat.storage_offset() % 8 else flat
    whole = len(flat) // 8 * 8
    return flat[:whole].view(torch.int64), flat[whole:]


def _of_axes(name: str, values: Any, dim: int) -> tuple[Any, ...]:
    """One for each axis."""
    if not isinstance(values, (tuple, list)):
        return (values,) * dim
    if len(values) != dim:
        raise ValueError(f"Flow: {name} must be one for all axes or one per axis, {dim} here, got {values!r}")
    return tuple(values)


def _make_box(shape: tuple[int, ...], boundary: tuple[str, ...], length: tuple[float, ...], mask: _Mask) -> _C.FlowBox:
    box = _C.FlowBox(list(shape), list(boundary), list(length), mask.obstacle)
    mask.keep()
    return box


def _of_numbers(name: str, value: object) -> Tensor:
    if not isinstance(value, (tuple, list)):
        raise TypeError(f"Flow: {name} must be a tensor or a tuple of numbers, got {value!r}")
    return kept_numbers([_check.real("Flow", f"every entry of {name}", v) for v in value])
