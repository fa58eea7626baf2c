"""Errors of the solution: against exact decays, and against a spectral reference.

- "taylor_green": the 2D vortex; "beltrami": its counterpart in 3D, where all three components move
- "random": a field of random phases in a ring of wavenumbers, in 2D; "taylor_green_3d": the 3D vortex. Their truth is
  `reference.solve`

With each error: the largest divergence on the solver's own grid, relative to the largest speed over a cell, and the
kinetic energy relative to the reference."""

import numpy as np

from benchmarks.mosaic import fields, reference
from benchmarks.mosaic.solvers import Box

TITLE = "Error of the solution"
FAMILY = "flow"

LENGTH = 2 * np.pi
FIELDS = {  # the field, its dimension, and the rate of its decay as a multiple of nu
    "taylor_green": (fields.taylor_green, 2, 2),
    "beltrami": (fields.beltrami, 3, 1),
    "random": (fields.RandomField(2, seed=0), 2, None),
    "taylor_green_3d": (fields.taylor_green_3d, 3, None),
}


def cases(quick):
    if quick:
        return [
            _case("taylor_green", 32, 0.05, 0.01, 20),
            _case("random", 32, 1e-3, 0.05, 20),
            _case("beltrami", 16, 0.05, 0.01, 20),
        ]
    return [
        *(_case("taylor_green", n, 0.05, 0.01, 1) for n in (16, 32, 64, 128)),
        *(_case("taylor_green", n, 0.05, 0.01, 20) for n in (16, 32, 64, 128)),
        *(_case("taylor_green", 64, nu, 0.05, 20) for nu in (1e-4, 1e-3, 1e-2, 5e-2)),
        *(_case("random", n, 1e-3, 0.05, 20) for n in (16, 32, 64, 128)),
        *(_case("random", 64, 1e-3, 0.05, steps) for steps in (5, 10, 50, 100)),
        *(_case("beltrami", n, 0.05, 0.01, 20) for n in (16, 32, 48, 64)),
        *(_case("taylor_green_3d", n, 0.01, 0.01, 50) for n in (16, 32, 48)),
    ]


def _case(field, n, nu, dt, steps):
    return {"field": field, "n": n, "nu": nu, "dt": dt, "steps": steps}


def run(solver, case):
    velocity, dim, rate = FIELDS[case["field"]]
    shape, nu, time = (case["n"],) * dim, case["nu"], case["dt"] * case["steps"]
    made = solver(Box(shape, nu, case["dt"]))
    start = fields.sample(velocity, shape, LENGTH, made.offsets)
    u = np.asarray(made.rollout(case["steps"])(start), np.float64)
    exact = np.exp(-rate * nu * time) * start if rate else _reference(velocity, dim, nu, time, shape, made.offsets)
    divergence = np.abs(fields.divergence(u, LENGTH, made.offsets)).max()
    return {
        "error": fields.relative_error(u, exact),
        "divergence": float(divergence * LENGTH / case["n"] / np.abs(u).max()),
        "energy": fields.energy(u) / fields.energy(exact),
    }


def _reference(velocity, dim, nu, time, shape, offsets):
    n, steps = (64, 100) if dim == 2 else (32, 50)
    return fields.sample(reference.solve(velocity, dim, nu, time, n, steps), shape, LENGTH, offsets)
