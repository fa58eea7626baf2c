"""Diffusion by finite volumes as entries of a matrix, for the solvers that need one."""

import numpy as np


def neighbours(cells):
    """(2, faces): the numbers of the two cells at each face inside the grid `cells` of numbers, axis by axis."""
    along = (np.moveaxis(cells, axis, 0) for axis in range(cells.ndim))
    return np.concatenate([np.stack([a[:-1].ravel(), a[1:].ravel()]) for a in along], 1)


def entries(k, pairs, held):
    """(values, (rows, columns)) of -h² ∇·(k ∇) on square cells, for k (n,) and harmonic means on the faces `pairs`.
    `held` are the cells beside a side whose value is given, once for each such side."""
    i, j = pairs
    weight = 2 * k[i] * k[j] / (k[i] + k[j])
    diagonal = sum(np.bincount(at, added, k.size) for at, added in ((i, weight), (j, weight), (held, 2 * k[held])))
    every = np.arange(k.size)
    return np.concatenate([-weight, -weight, diagonal]), (np.concatenate([i, j, every]), np.concatenate([j, i, every]))
