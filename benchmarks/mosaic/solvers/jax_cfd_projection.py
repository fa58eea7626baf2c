"""JAX-CFD: explicit steps on a staggered grid, then a projection.

It keeps a component on the high face of its axis, and component a belongs to array axis a; ours is the other way round
(component 0 along the last axis), so the components are turned over. Nothing is interpolated.

The default of the library is van Leer's limiter and, in periodic boxes, a pressure solve by FFT. `Central` takes
central differences, as this library does; `CentralCG` solves for the pressure by CG."""

from functools import partial

import jax.numpy as jnp
import jax_cfd.base as cfd

from benchmarks.mosaic import fields
from benchmarks.mosaic.solvers.jax_rollout import JaxFlow


class VanLeer(JaxFlow):
    CANNOT = {"design": "it knows no obstacles"}  # noqa: RUF012

    def __init__(self, box):
        super().__init__(box)
        if box.boundary != "periodic":
            raise NotImplementedError(self.CANNOT["design"])
        dim = len(box.shape)
        self.offsets = fields.high_faces(dim)
        self.grid = cfd.grids.Grid(box.shape, domain=((0, box.length),) * dim)
        self.boundary = cfd.boundaries.periodic_boundary_conditions(dim)
        self.step = cfd.equations.semi_implicit_navier_stokes(
            density=1.0, viscosity=box.nu, dt=box.dt, grid=self.grid, convect=self.convect, pressure_solve=self.solve()
        )

    convect = None  # the library's default

    def solve(self):
        return cfd.pressure.solve_fast_diag

    def enter(self, u):
        placed = (cfd.grids.GridArray(a, at, self.grid) for a, at in zip(u[::-1], self.grid.cell_faces, strict=True))
        return tuple(cfd.grids.GridVariable(a, self.boundary) for a in placed)

    def leave(self, v):
        return jnp.stack([a.data for a in v][::-1])


class Central(VanLeer):
    convect = staticmethod(cfd.advection.convect_linear)


class CentralCG(Central):
    def solve(self):
        return partial(cfd.pressure.solve_cg, rtol=self.box.rtol, atol=0.0)
