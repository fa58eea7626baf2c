"""Velocities on staggered grids for the tests of `Flow`."""

import math

import torch
from fibers import Fibers


def by_other_ways(outcome):
    """What outcome(**options) gives in the graph of second derivatives, with unrolled solves, and by kernels."""
    others = [outcome(graph=True), outcome(backward="unrolled")]
    with Fibers():
        return [*others, outcome()]


def positions(shape, channel, length=1.0, dtype=torch.float64):
    """x, y[, z] of the faces of a channel."""
    d, axes = len(shape), []
    for axis, n in enumerate(shape):
        low = 0.0 if axis == d - 1 - channel else 0.5
        axes.append((torch.arange(n, dtype=dtype) + low) * length / n)
    return torch.meshgrid(*axes, indexing="ij")[::-1]


def taylor_green(n, length=2 * math.pi, dtype=torch.float64):
    """The vortex that decays as exp(-2 nu t) on [0, 2π]²."""
    x, y = positions((n, n), 0, length, dtype)
    u = torch.sin(x) * torch.cos(y)
    x, y = positions((n, n), 1, length, dtype)
    return torch.stack([u, -torch.cos(x) * torch.sin(y)])[None]


def random_velocity(shape, batch=1, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, len(shape), *shape, generator=generator, dtype=dtype)
