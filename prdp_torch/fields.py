"""Functions of periodic velocity fields on the staggered grid of `NavierStokes`. All are differentiable.

Fields are (batch, 2 or 3, Ny, Nx) with dx = length/N. `length` is the side of the domain, one number or one per axis,
(y, x), as the steps take it. Channel 0 is u₁ along x, the last axis, on the left face of a cell. Channel 1 is u₂ along
y on its lower face. A third channel, the pressure in the cell's centre, has no influence.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from prdp_torch import _check
from prdp_torch.operators.base import full_precision
from prdp_torch.stepper import Stepper
from prdp_torch.types import Length

_Y, _X = -2, -1


def divergence(u: Tensor, length: Length = 1.0) -> Tensor:
    """∂u₁/∂x + ∂u₂/∂y of a periodic u in the cell centres by forward differences: (batch, 1, Ny, Nx). Where a
    `Flow` has walls or open ends, take `Flow.divergence`."""
    u1, u2, _ = _velocity("divergence", u)
    ly, lx = _sides("divergence", length)
    return _forward(u1, _X, lx) + _forward(u2, _Y, ly)


def curl(u: Tensor, length: Length = 1.0) -> Tensor:
    """The vorticity ∂u₂/∂x - ∂u₁/∂y of a periodic u at the lower left corner of each cell by backward differences:
    (batch, 1, Ny, Nx). Where a `Flow` has walls or open ends, it is wrong in the first row or column."""
    u1, u2, _ = _velocity("curl", u)
    ly, lx = _sides("curl", length)
    return _backward(u2, _X, lx) - _backward(u1, _Y, ly)


def project(u: Tensor, length: Length = 1.0) -> Tensor:
    """Remove the divergence of a periodic velocity: returns u - G φ, where D G φ = D u is solved by Fourier transform.
    This is the nearest field without discrete divergence. The mean velocity and the pressure do not change. Where a
    `Flow` has walls or open ends, take `Flow.project`."""
    u1, u2, u = _velocity("project", u)
    ly, lx = _sides("project", length)
    ny, nx = u.shape[-2:]
    ky, kx = (torch.arange(n, dtype=u.dtype, device=u.device) for n in (ny, nx // 2 + 1))
    # Eigenvalues of D G, the five-point Laplacian.
    symbol = -((2 * ny / ly * torch.sin(math.pi / ny * ky)[:, None]) ** 2)
    symbol = symbol - (2 * nx / lx * torch.sin(math.pi / nx * kx)) ** 2
    symbol = symbol.masked_fill(symbol == 0, 1.0)  # of the mean of φ, which G does not see
    phi = torch.fft.irfft2(torch.fft.rfft2(divergence(u, length)) / symbol, s=(ny, nx))
    return torch.cat([u1 - _backward(phi, _X, lx), u2 - _backward(phi, _Y, ly), u[:, 2:]], dim=1)


def downsample(u: Tensor) -> Tensor:
    """Take every second point along both axes, at the indices 1, 3, …. Ny and Nx must be odd; (Ny, Nx) becomes
    ((Ny - 1)/2, (Nx - 1)/2), for example 97 becomes 48 (paper, appendix C.6)."""
    u = _velocity("downsample", u)[2]
    if any(n % 2 == 0 for n in u.shape[-2:]):
        raise ValueError(f"downsample: Ny and Nx must be odd, got {tuple(u.shape[-2:])}")
    return u[..., 1::2, 1::2]


def rollout(stepper: Callable[[Tensor], Tensor], u: Tensor, steps: int) -> Tensor:
    """Repeat a step. Returns all states, u included: (batch, steps + 1, channel, *shape).

    `stepper` may be any callable, such as a network. For steppers of this library `Stepper.rollout` is called.
    """
    if isinstance(stepper, Stepper):
        return stepper.rollout(u, steps)
    if _check.whole("rollout", "steps", steps) < 0:
        raise ValueError(f"rollout: steps must be >= 0, got {steps}")
    states = [_check.dense("rollout", "u", u)]
    for _ in range(steps):
        writes = _check.writes(states[-1])
        states.append(stepper(states[-1]))
        if _check.writes(states[-2]) != writes:
            raise ValueError("rollout: the step changes its state in place; it must leave it as it is")
        if states[-1].shape != u.shape:
            raise ValueError(
                f"rollout: the step must keep the shape of its input, {tuple(u.shape)}, got {tuple(states[-1].shape)}"
            )
    return torch.stack(states, dim=1)


def _velocity(who: str, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """u₁ and u₂, each (batch, 1, Ny, Nx), and u."""
    u = full_precision(_check.dense(who, "u", u))
    if u.dim() != 4 or u.shape[1] not in (2, 3):
        raise ValueError(f"{who}: expected (batch, 2 or 3, Ny, Nx), got {tuple(u.shape)}")
    if u.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{who}: expected float32 or float64, got {u.dtype}")
    return u[:, 0:1], u[:, 1:2], u


def _sides(who: str, length: Length) -> list[float]:
    """The sides along y and x."""
    sides = _check.lengths(who, length, 2) or [1.0, 1.0]
    if not all(0.0 < side < math.inf for side in sides):
        raise ValueError(f"{who}: length must be finite and > 0, got {length!r}")
    return sides


def _forward(v: Tensor, axis: int, length: float) -> Tensor:
    return (v.roll(-1, axis) - v) * (v.shape[axis] / length)


def _backward(v: Tensor, axis: int, length: float) -> Tensor:
    return (v - v.roll(1, axis)) * (v.shape[axis] / length)
