"""Stencils of every kind, their random coefficients, and their matrices, which numpy builds entry by entry."""

import itertools

import numpy as np
import pytest
import torch
from helpers import field

NEAREST = {
    1: [(0,), (-1,), (1,)],
    2: [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)],
    3: [(0, 0, 0), (0, 0, -1), (0, 0, 1), (0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0)],
}
NINE = list(itertools.product((-1, 0, 1), repeat=2))
FAR_1D = [(-2,), (-1,), (0,), (1,), (2,)]
FAR_2D = [(0, 0), (2, -1), (-2, 2), (0, 2), (1, 0), (-1, -1), (0, -2)]
FAR_3D = [(0, 0, 0), (2, 0, -1), (-2, 1, 2), (0, -1, 0), (1, 1, 1), (0, 0, -2)]
ONE_SIDED = [(1, 0), (0, 0), (0, -1)]

# shape, offsets, boundary
CASES = [((n,), NEAREST[1], b) for n in (1, 2, 3, 7, 17, 33) for b in ("zero", "periodic")]
CASES += [((n,), FAR_1D, b) for n in (1, 2, 3, 4, 5, 18) for b in ("zero", "periodic")]
CASES += [
    (shape, offsets, b)
    for shape in ((1, 1), (3, 2), (5, 17))
    for offsets in (NEAREST[2], NINE, FAR_2D, ONE_SIDED)
    for b in ("zero", "periodic", ("periodic", "zero"))
]
CASES += [
    (shape, offsets, b)
    for shape in ((1, 2, 3), (3, 4, 5))
    for offsets in (NEAREST[3], FAR_3D)
    for b in ("zero", "periodic", ("zero", "periodic", "periodic"))
]
cases = pytest.mark.parametrize("shape, offsets, boundary", CASES)

# Of each kind one, for what takes longer.
FEW = [
    ((9,), NEAREST[1], "zero"),
    ((17,), NEAREST[1], "periodic"),
    ((6,), FAR_1D, "periodic"),
    ((4, 17), NEAREST[2], "zero"),
    ((5, 3), NEAREST[2], ("periodic", "zero")),
    ((4, 5), NINE, "periodic"),
    ((5, 4), FAR_2D, ("zero", "periodic")),
    ((3, 2, 4), NEAREST[3], ("periodic", "zero", "periodic")),
    ((3, 4, 3), FAR_3D, "zero"),
]
few = pytest.mark.parametrize("shape, offsets, boundary", FEW)


def dense(coefficients, offsets, boundary):
    """The matrices of (batch, k, *shape) as (batch, n, n), entry by entry."""
    coefficients = coefficients.detach().double().numpy()
    batch, _, *shape = coefficients.shape
    boundary = (boundary,) * len(shape) if isinstance(boundary, str) else boundary
    number = np.arange(np.prod(shape)).reshape(shape)
    matrices = np.zeros((batch, number.size, number.size))
    for k, offset in enumerate(offsets):
        for point in np.ndindex(*shape):
            there = np.add(point, offset)
            outside = (there < 0) | (there >= shape)
            if any(o and b == "zero" for o, b in zip(outside, boundary, strict=True)):
                continue
            column = number[tuple(np.mod(there, shape))]
            matrices[:, number[point], column] += coefficients[(slice(None), k, *point)]
    return matrices


def random_coefficients(shape, offsets, batch=2, seed=3, dtype=torch.float64, dominant=True):
    """(batch, k, *shape); rows, though not columns, are dominated by the diagonal where `dominant`."""
    c = field(shape, batch, seed=seed, dtype=dtype, channels=len(offsets))
    if dominant:
        c[:, offsets.index((0,) * len(shape))] = 1.5 * c.abs().sum(1) + 1
    return c
