"""The operators of the built-in equations."""

from torch import Tensor

from prdp_torch import _check
from prdp_torch.operators.base import Operator
from prdp_torch.types import Length, Number, Shape


class Poisson(Operator):
    """The Laplacian with zero boundary values: Σ_d (v_{i-1} - 2 v_i + v_{i+1}) / dx_d². It is negative definite.

    Args:
        shape: the grid of unknowns, (N,), (Ny, Nx) or (Nz, Ny, Nx).
        length: the side of the domain, one number or one per axis in the order of `shape`; dx = length/(N + 1).
    """

    kind = "poisson"

    def __init__(self, shape: Shape, length: Length = 1.0) -> None:
        shape = _check.shape("Poisson", shape)
        super().__init__(shape, _check.lengths("Poisson", length, len(shape)), {})

    def _settings(self) -> dict[str, object]:
        return _of_length(self.parameters)


class Heat(Operator):
    """The operator of an implicit Euler step of the heat equation: I - nu dt L, with the Laplacian L of `Poisson`.

    Args:
        shape, length: as in `Poisson`.
        nu: diffusivity >= 0, length²/time; a number or a tensor, which gets a gradient: 0-dimensional, or (batch,),
            one for each sample, in the dtype of the vectors.
        dt: time step > 0.
    """

    kind = "heat"

    def __init__(self, shape: Shape, nu: Number, dt: float, length: Length = 1.0) -> None:
        shape = _check.shape("Heat", shape)
        parameters = [_check.real("Heat", "dt", dt), *_check.lengths("Heat", length, len(shape))]
        super().__init__(shape, parameters, {"nu": nu})

    def _settings(self) -> dict[str, object]:
        return _of_time(self.parameters)


class Burgers(Operator):
    """The operator of an implicit Euler step of Burgers' equation on a periodic grid: I + dt Γ - nu dt L on each
    velocity channel.

    Γ = Σ_d max(w⁻, 0) B_d + min(w⁺, 0) F_d is first-order upwind advection. B and F are backward and forward
    differences, and w∓ are the winds at the lower and upper face of a cell. Rows sum to 1, and entries off the
    diagonal are <= 0.

    Args:
        winds: (batch, 1, N) or (batch, 2, Ny, Nx); batch 1 is for all samples alike. Channel 0 is the velocity
            along x, the last axis, and channel 1 that along y. The dtype is that of the vectors.
        nu, dt: as in `Heat`.
        length: as in `Poisson`, but dx = length/N.

    Source: paper, appendix C.5.
    """

    kind = "burgers"

    def __init__(self, winds: Tensor, nu: Number, dt: float, length: Length = 1.0) -> None:
        super().__init__(*flow("Burgers", "winds", winds, nu, dt, length))

    def _settings(self) -> dict[str, object]:
        return _of_time(self.parameters)

    def _unknowns(self) -> int:
        return self.tensors[0].shape[1] * super()._unknowns()


class NavierStokes(Operator):
    """The operator of an implicit Euler step of the incompressible Navier-Stokes equations on a periodic staggered
    grid, linearised about `velocity`.

    Vectors are (batch, 3, Ny, Nx). Their channels are u₁ along x on the left face of each cell, u₂ along y on its
    lower face, and p in its centre:

        A = [[C₁, 0, G₁], [0, C₂, G₂], [D₁, D₂, 0]],    C_k = I/dt + Γ_k - nu L

    The divergence D uses forward differences, and the gradient G = -Dᵀ backward differences. Γ_k is first-order
    upwind advection with the velocity at the points of u_k. Constant pressure is the null vector of A and of Aᵀ.

    Args:
        velocity: (batch or 1, 2 or 3, Ny, Nx). A third channel, the pressure, has no influence.
        nu, dt: as in `Heat`.
        length: as in `Poisson`, but dx = length/N.

    Source: paper, appendix C.6.
    """

    kind = "navier_stokes"

    def __init__(self, velocity: Tensor, nu: Number, dt: float, length: Length = 1.0) -> None:
        super().__init__(*flow("NavierStokes", "velocity", velocity, nu, dt, length))

    def _settings(self) -> dict[str, object]:
        return _of_time(self.parameters)

    def _unknowns(self) -> int:
        return 3 * super()._unknowns()


def _of_length(lengths: list[float]) -> dict[str, object]:
    """The lengths of the sides; none are 1."""
    return {"length": tuple(lengths)} if lengths else {}


def _of_time(parameters: list[float]) -> dict[str, object]:
    return {"dt": parameters[0], **_of_length(parameters[1:])}


def flow(
    who: str, name: str, winds: Tensor, nu: Number, dt: float, length: Length
) -> tuple[list[int], list[float], dict[str, Number]]:
    """Shape, parameters and tensors of a flow linearised about winds (batch, channel, *shape)."""
    if _check.dense(who, name, winds).dim() < 3:
        raise ValueError(f"{who}: {name} must have shape (batch, channel, *shape), got {tuple(winds.shape)}")
    parameters = [_check.real(who, "dt", dt), *_check.lengths(who, length, winds.dim() - 2)]
    return list(winds.shape[2:]), parameters, {name: winds, "nu": nu}
