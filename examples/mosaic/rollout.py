"""What the Tesseract of a flow computes, in torch alone: velocities in the centres of cells, and their gradients."""

from collections.abc import Sequence

import torch
from torch import Tensor

import prdp_torch as prdp
from prdp_torch.flow import Boundary


def rollout(
    v0: Tensor, viscosity: Tensor, dt: float, steps: int, extent: float, boundary: Sequence[Boundary]
) -> Tensor:
    """Follow a flow from the velocity v0 in the centres of the cells to the one after so many steps.

    Args:
        v0: (nx, ny, nz, d), with nz = 1 and d = 2 for a plane flow. Component 0 is the velocity along x.
        viscosity: of any shape with one element. Gets a gradient, as v0 does.
        dt: time step.
        steps: how many.
        extent: the side of the domain.
        boundary: "periodic" or "wall", one for all axes, or one per axis in the order x, y, z.

    The faces, where `prdp.Flow` has its velocities, take the means of the two cells beside them. The cells take the
    means of their two faces.
    """
    dim = v0.shape[-1]
    u = v0.reshape(*v0.shape[:dim], dim).permute(dim, *reversed(range(dim)))  # (d, [nz,] ny, nx)
    names = list(boundary) * dim if len(boundary) == 1 else list(reversed(boundary))
    nu = viscosity.reshape(())
    flow = prdp.Flow(u.shape[1:], nu, dt, boundary=names, length=extent)
    faces = torch.stack([0.5 * (u[c] + u[c].roll(1, dim - 1 - c)) for c in range(dim)])[None]
    u = flow.rollout(faces, steps)[0, -1] if steps else faces[0]
    centres = torch.stack([0.5 * (u[c] + u[c].roll(-1, dim - 1 - c)) for c in range(dim)])
    return centres.permute(*reversed(range(1, dim + 1)), 0).reshape(v0.shape)
