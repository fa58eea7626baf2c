"""The operators of the problems as stencils over rolled and padded arrays, for torch and for JAX alike.

A backend is an object with `roll(v, shift, axis)`, `pad(v, axis)` (one zero on either side) and
`stack(parts, axis)`; axes count from the end. Arrays are (batch, channel, *shape).
"""

import numpy as np
import torch


class TorchBackend:
    stack = staticmethod(torch.stack)

    @staticmethod
    def roll(v, shift, axis):
        return torch.roll(v, shift, axis)

    @staticmethod
    def pad(v, axis):
        return torch.nn.functional.pad(v, [0, 0] * (-axis - 1) + [1, 1])


class Heat:
    """I - nu dt L with zeros beyond the boundary; symmetric."""

    def __init__(self, problem, backend, array):
        self.backend = backend
        self.weights = [problem.nu * problem.dt * (n + 1) ** 2 for n in problem.shape]
        self.diagonal = 1 + 2 * sum(self.weights)

    def off_diagonal(self, v):
        total = 0.0
        for axis, weight in zip(range(-len(self.weights), 0), self.weights, strict=True):
            padded = self.backend.pad(v, axis)
            total = total - weight * (_slice(padded, axis, 0, -2) + _slice(padded, axis, 2, None))
        return total

    def apply(self, v):
        return self.diagonal * v + self.off_diagonal(v)

    transpose = apply


def _slice(v, axis, begin, end):
    index = [slice(None)] * v.ndim
    index[axis] = slice(begin, end)
    return v[tuple(index)]


class Upwind:
    """diagonal v_i + Σ_d lower_d v_{i-1} + upper_d v_{i+1}, periodic; the coefficients are fields."""

    def __init__(self, diagonal, lower, upper, backend):
        self.diagonal, self.lower, self.upper, self.backend = diagonal, lower, upper, backend

    def apply(self, v):
        total = self.diagonal * v
        for axis in self.lower:
            total = total + self.lower[axis] * self.backend.roll(v, 1, axis)
            total = total + self.upper[axis] * self.backend.roll(v, -1, axis)
        return total

    def transpose(self, v):
        total = self.diagonal * v
        for axis in self.lower:
            total = total + self.backend.roll(self.lower[axis] * v, -1, axis)
            total = total + self.backend.roll(self.upper[axis] * v, 1, axis)
        return total


def upwind(faces, shape, nu, scale, shift, backend, array):
    """shift + scale (Γ - nu L) of the winds (below, above) at the two faces, {axis: (below, above)} in numpy."""
    diagonal, lower, upper = shift, {}, {}
    for axis, (below, above) in faces.items():
        n = shape[axis]
        lower[axis] = scale * (-n * np.maximum(below, 0) - nu * n**2)
        upper[axis] = scale * (n * np.minimum(above, 0) - nu * n**2)
        diagonal = diagonal - lower[axis] - upper[axis]
    convert = lambda fields: {axis: array(field) for axis, field in fields.items()}  # noqa: E731
    return Upwind(array(diagonal), convert(lower), convert(upper), backend)


def burgers(problem, backend, array):
    w = problem.winds.numpy()
    faces = {-1: ((np.roll(w, 1, -1) + w) / 2, (w + np.roll(w, -1, -1)) / 2)}
    return upwind(faces, problem.shape, problem.nu, problem.dt, 1.0, backend, array)


def diffusion(kappa, dt, backend):
    """I - dt ∇·(κ ∇) for κ (Ny, Nx), an array of the backend's library; means of κ on the faces."""
    diagonal, lower, upper = 1.0, {}, {}
    for axis in (-1, -2):
        after = (kappa + backend.roll(kappa, -1, axis)) * (0.5 * dt * kappa.shape[axis] ** 2)
        before = backend.roll(after, 1, axis)
        lower[axis], upper[axis] = -before, -after
        diagonal = diagonal + before + after
    return Upwind(diagonal, lower, upper, backend)


class NavierStokes:
    """[[C₁, 0, G₁], [0, C₂, G₂], [D₁, D₂, 0]], channels u₁, u₂, p."""

    def __init__(self, problem, backend, array):
        self.backend, (self.ny, self.nx) = backend, problem.shape
        u1, u2 = problem.winds.numpy()[:, 0], problem.winds.numpy()[:, 1]
        across1 = (u2 + np.roll(u2, 1, -1) + np.roll(u2, -1, -2) + np.roll(u2, (1, -1), (-1, -2))) / 4
        across2 = (u1 + np.roll(u1, 1, -2) + np.roll(u1, -1, -1) + np.roll(u1, (1, -1), (-2, -1))) / 4
        make = lambda x, y: upwind(  # noqa: E731
            {-1: (x, x), -2: (y, y)}, problem.shape, problem.nu, 1.0, 1 / problem.dt, backend, array
        )
        self.c1, self.c2 = make(u1, across1), make(across2, u2)

    def _gradient(self, p):
        roll = self.backend.roll
        return self.nx * (p - roll(p, 1, -1)), self.ny * (p - roll(p, 1, -2))

    def _divergence(self, v1, v2):
        roll = self.backend.roll
        return self.nx * (roll(v1, -1, -1) - v1) + self.ny * (roll(v2, -1, -2) - v2)

    def apply(self, v):
        v1, v2, p = v[..., 0, :, :], v[..., 1, :, :], v[..., 2, :, :]
        g1, g2 = self._gradient(p)
        return self.backend.stack((self.c1.apply(v1) + g1, self.c2.apply(v2) + g2, self._divergence(v1, v2)), -3)

    def transpose(self, v):
        v1, v2, q = v[..., 0, :, :], v[..., 1, :, :], v[..., 2, :, :]
        g1, g2 = self._gradient(q)  # Dᵀ = -G and Gᵀ = -D
        parts = (self.c1.transpose(v1) - g1, self.c2.transpose(v2) - g2, -self._divergence(v1, v2))
        return self.backend.stack(parts, -3)


def make(problem, backend, array):
    """The problem's stencil; `array` brings a numpy array into the library."""
    if problem.name.startswith("heat"):
        return Heat(problem, backend, array)
    if problem.kappa is not None:
        return diffusion(array(problem.kappa.numpy()), problem.dt, backend)
    return (burgers if problem.name.startswith("burgers") else NavierStokes)(problem, backend, array)
