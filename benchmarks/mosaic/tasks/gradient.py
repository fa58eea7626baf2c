"""The gradient of sum(u²) after some steps for the initial state, beside central differences, in float64.

The field is the ring of random phases. The gradient is that of the state which the solver itself keeps, at its own
points."""

import numpy as np

from benchmarks.mosaic import differences, fields
from benchmarks.mosaic.solvers import Box

TITLE = "Gradient"
FAMILY = "flow"

N, NU, DT = 16, 1e-3, 0.05


def cases(quick):
    horizons = {2: (5,) if quick else (5, 10, 20, 40, 80, 160, 320), 3: (5,) if quick else (5, 20, 80)}
    return [{"dim": dim, "n": N, "steps": steps} for dim, of_dim in horizons.items() for steps in of_dim]


def start(made, dim, n):
    return fields.sample(fields.RandomField(dim, seed=0), (n,) * dim, 2 * np.pi, made.offsets)


def run(solver, case):
    dim, n, steps = case["dim"], case["n"], case["steps"]
    made = solver(Box((n,) * dim, NU, DT, double=True))
    u0 = start(made, dim, n)
    _, gradient = made.gradient(steps)(u0, np.zeros_like(u0))
    rollout = made.rollout(steps)
    return differences.compare(
        lambda u: float((rollout(u) ** 2).sum()), u0, gradient, directions=20 if dim == 2 else 10
    )
