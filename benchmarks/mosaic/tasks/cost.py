"""Seconds and peak memory of a rollout, and of it with the gradient of sum(u²), in float32 on one core.

2D: the ring of random phases; 3D: the Taylor–Green vortex. Compilation is timed apart."""

import time

import numpy as np

from benchmarks.mosaic import fields, readings
from benchmarks.mosaic.solvers import Box

TITLE = "Cost"
FAMILY = "flow"

NU, DT = 0.01, 0.01


def cases(quick):
    if quick:
        return [_case(2, 32, 10), _case(3, 16, 5)]
    return [
        *(_case(2, n, 100) for n in (64, 128, 192, 256)),
        *(_case(2, 128, steps) for steps in (10, 30, 300, 1000)),
        *(_case(3, n, 50) for n in (16, 32, 48, 64)),
        *(_case(3, 48, steps) for steps in (10, 100)),
    ]


def _case(dim, n, steps):
    return {"dim": dim, "n": n, "steps": steps}


def run(solver, case):
    dim, n, steps = case["dim"], case["n"], case["steps"]
    small = solver(Box((8,) * dim, NU, DT))  # what is loaded and set up once
    small.gradient(1)(*(2 * [np.zeros((dim, *(8,) * dim), np.float32)]))
    made = solver(Box((n,) * dim, NU, DT))
    velocity = fields.RandomField(2, seed=0) if dim == 2 else fields.taylor_green_3d
    u0 = fields.sample(velocity, (n,) * dim, 2 * np.pi, made.offsets).astype(np.float32)
    return {
        **_measured("forward", lambda: made.rollout(steps), u0),
        **_measured("gradient", lambda: made.gradient(steps), u0, np.zeros_like(u0)),
    }


def _measured(part, compile_it, *arguments):
    started = time.process_time()
    call = compile_it()
    compiled = time.process_time() - started
    found, answer = readings.of(lambda: call(*arguments))
    if not np.isfinite(answer[1] if part == "gradient" else answer).all():
        raise FloatingPointError(f"the {part} is not finite")
    return {f"{part}_compile_seconds": compiled, **{f"{part}_{key}": value for key, value in found.items()}}
