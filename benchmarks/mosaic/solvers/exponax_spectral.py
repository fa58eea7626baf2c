"""Exponax: exponential time differencing in Fourier space, of second order, periodic boxes only.

Its components belong to array axis a; ours are the other way round and are turned over. All of them are in the cell's
low corner. In 2D its state is the vorticity: the velocity is turned into it before the first step and back after the
last one, by FFT, which loses the mean velocity and whatever is not divergence-free."""

import exponax
import jax.numpy as jnp

from benchmarks.mosaic import fields
from benchmarks.mosaic.solvers.jax_rollout import JaxFlow


class Spectral(JaxFlow):
    CANNOT = {"design": "a Fourier basis has neither walls nor obstacles"}  # noqa: RUF012

    def __init__(self, box):
        super().__init__(box)
        dim, n = len(box.shape), box.shape[0]
        if box.boundary != "periodic":
            raise ValueError(self.CANNOT["design"])
        self.offsets = fields.corners(dim)
        make = exponax.stepper.NavierStokesVorticity if dim == 2 else exponax.stepper.NavierStokesVelocity
        self.stepper = make(dim, box.length, n, box.dt, diffusivity=box.nu)
        self.derivative = exponax.spectral.build_derivative_operator(dim, box.length, n)
        laplacian = (self.derivative**2).sum(0)
        self.inverse = jnp.where(laplacian == 0, 0, 1 / jnp.where(laplacian == 0, 1, laplacian))

    def enter(self, u):
        u = u[::-1]
        if len(u) == 3:
            return u
        transformed = exponax.fft(u, num_spatial_dims=2)
        along = self.derivative
        return self._back(along[1] * transformed[0] - along[0] * transformed[1])[None]

    def leave(self, carry):
        if len(carry) == 3:
            return carry[::-1]
        potential = self.inverse * exponax.fft(carry, num_spatial_dims=2)[0]
        return jnp.stack([-self._back(self.derivative[0] * potential), self._back(self.derivative[1] * potential)])

    def _back(self, transformed):
        return exponax.ifft(transformed[None], num_spatial_dims=2, num_points=self.box.shape[0])[0]

    def step(self, carry):
        return self.stepper(carry)


class Stored(Spectral):
    """Faster, with several times the memory."""

    RECOMPUTE = False
