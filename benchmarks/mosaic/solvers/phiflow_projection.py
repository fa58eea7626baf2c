"""PhiFlow on JAX: advection, explicit diffusion and a projection by CG on a staggered grid.

Its axes are (x, y[, z]); ours are the other way round, so the arrays are transposed on the way in and out. In a
periodic box its components are on the low faces, as ours. Between walls it keeps the inner faces alone; those of the
wall, which carry nothing, are added on the way out.

`SemiLagrangian` is what its examples take; `Central` takes its central differences."""

import warnings

import jax.numpy as jnp
import numpy as np
from phi.jax import flow as phi

from benchmarks.mosaic import fields
from benchmarks.mosaic.solvers.jax_rollout import JaxFlow


class _Projection(JaxFlow):
    def __init__(self, box):
        super().__init__(box)
        phi.math.set_global_precision(64 if box.double else 32)
        warnings.filterwarnings("ignore", "Rank deficiency")  # that of the pressure, which its CG allows for
        dim = len(box.shape)
        self.offsets = fields.low_faces(dim)
        self.names = "xyz"[:dim]
        self.bounds = phi.Box(**dict.fromkeys(self.names, box.length))
        self.boundary = phi.PERIODIC if box.boundary == "periodic" else {"x": phi.PERIODIC, "y": 0}
        self.solve = phi.Solve("CG", box.rtol, 0.0)
        self.obstacles = ()
        if box.obstacle is not None:
            self.obstacles = (self._cells(box.obstacle),)

    def _cells(self, obstacle):
        """The solid cells as boxes, so that the obstacle is the one of the task and not a disc."""
        h = self.box.length / obstacle.shape[0]
        low = h * np.argwhere(obstacle)[:, ::-1]
        corner = phi.wrap(low, phi.instance("cells"), phi.channel(vector="x,y"))  # stays in NumPy: it is no variable
        return phi.Box(corner, corner + h)

    def grid(self, u):
        axes, names = tuple(range(u.ndim - 2, -1, -1)), phi.spatial(*self.names)
        components = [jnp.transpose(c, axes) for c in u]
        if self.box.boundary == "channel":
            components[1] = components[1][:, 1:]
        values = [phi.math.tensor(c, names) for c in components]
        return phi.StaggeredGrid(
            phi.math.stack(values, phi.dual(vector=",".join(self.names))), self.boundary, bounds=self.bounds
        )

    def state(self, v):
        components = [v.values[{"~vector": name}].native(",".join(self.names)) for name in self.names]
        if self.box.boundary == "channel":
            components[1] = jnp.pad(components[1], ((0, 0), (1, 0)))
        return jnp.stack([jnp.transpose(c) for c in components])

    def advect(self, v):
        raise NotImplementedError

    def step(self, u):
        return self.step_with_pressure(u)[0]

    def step_with_pressure(self, u):
        v = phi.diffuse.explicit(self.advect(self.grid(u)), self.box.nu, self.box.dt)
        v, pressure = phi.fluid.make_incompressible(v, self.obstacles, self.solve)
        return self.state(v), jnp.transpose(pressure.values.native(",".join(self.names))) / self.box.dt

    @staticmethod
    def centred(u):
        return 0.5 * (u[0] + jnp.roll(u[0], -1, -1))


class SemiLagrangian(_Projection):
    def advect(self, v):
        return phi.advect.semi_lagrangian(v, v, self.box.dt)


class Central(_Projection):
    def advect(self, v):
        return v + self.box.dt * phi.advect.differential(v, v, order=2)
