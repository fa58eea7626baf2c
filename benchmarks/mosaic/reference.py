"""An independent truth for periodic boxes: a pseudo-spectral solver with Runge-Kutta steps, in float64."""

import numpy as np


def solve(velocity, dim, nu, time, n=64, steps=200, length=2 * np.pi):
    """The field at `time` as a function of position, from `velocity(x, y[, z])` on a box of side `length`.

    Dealiased by the rule of two thirds; diffusion is exact (integrating factor), the rest a classical Runge-Kutta
    method of fourth order."""
    from benchmarks.mosaic import fields

    axes = tuple(range(1, dim + 1))
    wave = np.fft.fftfreq(n, 1 / n) * 2 * np.pi / length
    k = np.stack(np.meshgrid(*[wave] * dim, indexing="ij")[::-1])  # component 0 belongs to the last axis
    squared = (k**2).sum(0)
    kept = (np.abs(k) < 2 / 3 * np.abs(wave).max()).all(0)

    def rate(u_hat):
        """-(u·∇)u without its gradient part."""
        u = np.fft.ifftn(u_hat, axes=axes).real
        gradients = [np.fft.ifftn(1j * k[a] * u_hat, axes=axes).real for a in range(dim)]
        advection = np.fft.fftn(-sum(u[a] * gradients[a] for a in range(dim)), axes=axes) * kept
        return advection - k * ((k * advection).sum(0) / np.where(squared > 0, squared, 1))

    dt = time / steps
    half = np.exp(-nu * squared * dt / 2)
    start = fields.sample(velocity, (n,) * dim, length, fields.corners(dim))
    u = np.fft.fftn(start, axes=axes) * kept
    for _ in range(steps):
        a = rate(u)
        b = rate(half * (u + dt / 2 * a))
        c = rate(half * u + dt / 2 * b)
        d = rate(half**2 * u + dt * half * c)
        u = half**2 * u + dt / 6 * (half**2 * a + 2 * half * (b + c) + d)
    return _Field(u / n**dim, k, kept)


class _Field:
    """The sum of the modes that carry anything, at any position."""

    def __init__(self, coefficients, k, kept):
        large = kept & (np.abs(coefficients).max(0) > 1e-9 * np.abs(coefficients).max())
        self.coefficients, self.k = coefficients[:, large].T, k[:, large].T

    def __call__(self, *position):
        components = [0.0] * len(position)
        for coefficient, k in zip(self.coefficients, self.k, strict=True):
            mode = np.exp(1j * sum(a * x for a, x in zip(k, position, strict=True)))
            components = [u + (c * mode).real for u, c in zip(components, coefficient, strict=True)]
        return components
