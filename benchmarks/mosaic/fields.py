"""Velocity fields given as functions of position, and what is measured of a discrete one.

A state is an array (d, *shape). The axes are those of `prdp.Flow`: the last one is x, and component 0 is the velocity
along x. Solvers keep a component at different points of a cell: `offsets[c]` is where component c is, in cells from the
cell's low corner, one entry per array axis. A field is evaluated at these points, so that nothing is interpolated.
"""

import numpy as np


def low_faces(dim):
    """Component c on the low face of its own axis (the MAC grid of `prdp.Flow` and of PhiFlow's periodic boxes)."""
    return _faces(dim, 0.0)


def high_faces(dim):
    """Component c on the high face of its own axis (JAX-CFD)."""
    return _faces(dim, 1.0)


def corners(dim):
    """All components in the low corner of the cell (collocated: Exponax)."""
    return [[0.0] * dim for _ in range(dim)]


def _faces(dim, at):
    return [[at if axis == dim - 1 - c else 0.5 for axis in range(dim)] for c in range(dim)]


def sample(velocity, shape, length, offsets):
    """The state of a field `velocity(x, y[, z])`, which returns one array per component."""
    components = []
    for c, offset in enumerate(offsets):
        axes = [length * (np.arange(n) + at) / n for n, at in zip(shape, offset, strict=True)]
        positions = np.meshgrid(*axes, indexing="ij")[::-1]
        components.append(np.broadcast_to(velocity(*positions)[c], shape))
    return np.stack(components)


def taylor_green(x, y):
    """The vortex that decays as exp(-2 nu t) on [0, 2π]²."""
    return np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)


def taylor_green_3d(x, y, z):
    """The 3D vortex, which has no closed solution."""
    return np.sin(x) * np.cos(y) * np.cos(z), -np.cos(x) * np.sin(y) * np.cos(z), 0 * z


def beltrami(x, y, z):
    """A flow parallel to its own vorticity (Arnold, Beltrami, Childress): it decays as exp(-nu t) on [0, 2π]³."""
    return np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)


class RandomField:
    """A divergence-free sum of Fourier modes on [0, 2π]^d with random phases and directions.

    The amplitude of a mode k is exp(-(|k| - ring)² / (2 width²)); the largest speed on a fine grid is `speed`."""

    def __init__(self, dim, seed, ring=2.0, width=0.5, speed=0.3):
        generator = np.random.default_rng(seed)
        reach = int(np.ceil(ring + 3 * width))
        waves = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * dim, indexing="ij"), -1).reshape(-1, dim)
        waves = waves[len(waves) // 2 + 1 :]  # one of each pair k, -k
        size = np.linalg.norm(waves, axis=1)
        directions = generator.standard_normal(waves.shape)
        directions -= waves * ((directions * waves).sum(1) / size**2)[:, None]
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        amplitudes = np.exp(-((size - ring) ** 2) / (2 * width**2))
        phases = generator.uniform(0, 2 * np.pi, len(waves))
        kept = amplitudes > 1e-3
        self.waves, self.phases = waves[kept], phases[kept]
        self.coefficients = (amplitudes[:, None] * directions)[kept]
        fine = sample(self, (32,) * dim, 2 * np.pi, corners(dim))
        self.coefficients *= speed / np.sqrt((fine**2).sum(0)).max()

    def __call__(self, *position):
        components = [0.0] * len(position)
        for wave, phase, coefficient in zip(self.waves, self.phases, self.coefficients, strict=True):
            mode = np.cos(sum(k * x for k, x in zip(wave, position, strict=True)) + phase)
            components = [u + c * mode for u, c in zip(components, coefficient, strict=True)]
        return components


def divergence(u, length, offsets):
    """The divergence that the solver's own grid sees, on a periodic box: differences of faces, or spectral."""
    symbols = _divergence_symbols(u.shape[1:], length, offsets)
    transformed = np.fft.fftn(u, axes=range(1, u.ndim))
    return np.fft.ifftn((symbols * transformed).sum(0)).real


def project(u, length, offsets):
    """The divergence-free part of a state on a periodic box."""
    symbols = _divergence_symbols(u.shape[1:], length, offsets)
    transformed = np.fft.fftn(u, axes=range(1, u.ndim))
    squared = (np.abs(symbols) ** 2).sum(0)
    potential = (symbols * transformed).sum(0) / np.where(squared > 0, squared, 1)
    return np.fft.ifftn(transformed - symbols.conj() * potential, axes=range(1, u.ndim)).real


def _divergence_symbols(shape, length, offsets):
    """What the derivative of each component along its own axis is in Fourier space."""
    dim, symbols = len(shape), []
    for c, offset in enumerate(offsets):
        axis = dim - 1 - c
        n = shape[axis]
        h, k = length / n, 2 * np.pi * np.fft.fftfreq(n, length / n)
        if not any(offset):  # collocated
            symbol = 1j * np.where(2 * np.abs(np.fft.fftfreq(n, 1 / n)) == n, 0, k)
        else:  # from the low faces to the next ones, or from the previous ones to the high faces
            symbol = (np.exp(1j * k * h) - 1) / h if offset[axis] == 0.0 else (1 - np.exp(-1j * k * h)) / h
        symbols.append(np.broadcast_to(symbol.reshape([-1 if a == axis else 1 for a in range(dim)]), shape))
    return np.stack(symbols)


def energy(u):
    """The kinetic energy per volume."""
    return 0.5 * float((np.asarray(u, np.float64) ** 2).sum(0).mean())


def relative_error(u, exact):
    return float(np.linalg.norm(u - exact) / np.linalg.norm(exact))
