"""The initial state from the final one, in 3D: L-BFGS from zero, with gradients made divergence-free.

The truth is a random field in the shell |k| = 2 of width 1, with a largest speed of 1. Each solver has to find what it
has started from itself."""

import numpy as np

from benchmarks.mosaic import fields, optimise
from benchmarks.mosaic.solvers import Box

TITLE = "Recovery of an initial state"
FAMILY = "flow"

LENGTH, NU, DT = 2 * np.pi, 0.01, 0.02


def cases(quick):
    if quick:
        return [{"n": 8, "steps": 5, "iterations": 5, "seed": 0}]
    return [{"n": 16, "steps": 100, "iterations": 100, "seed": seed} for seed in range(3)]


def run(solver, case):
    shape = (case["n"],) * 3
    made = solver(Box(shape, NU, DT))
    truth = fields.sample(fields.RandomField(3, case["seed"], 2.0, 1.0, 1.0), shape, LENGTH, made.offsets)
    truth = fields.project(truth, LENGTH, made.offsets)
    final = made.rollout(case["steps"])(truth)
    gradient = made.gradient(case["steps"])

    def misfit(u0):
        value, slope = gradient(u0, final)
        return value / final.size, fields.project(np.asarray(slope, np.float64), LENGTH, made.offsets) / final.size

    found, losses = optimise.lbfgs(misfit, np.zeros_like(truth), case["iterations"])
    return {"losses": losses, "error": fields.relative_error(found, truth)}
