"""How many steps the gradient of `gradient` stays finite for, in float32: the largest of 40, 80, …, 10,240."""

import numpy as np

from benchmarks.mosaic.solvers import Box
from benchmarks.mosaic.tasks import gradient

TITLE = "Horizon of finite gradients"
FAMILY = "flow"


def cases(quick):
    steps = (40,) if quick else tuple(40 * 2**k for k in range(9))
    return [{"dim": dim, "n": gradient.N, "steps": steps_} for dim in (2, 3) for steps_ in steps]


def run(solver, case):
    dim, n = case["dim"], case["n"]
    made = solver(Box((n,) * dim, gradient.NU, gradient.DT))
    u0 = gradient.start(made, dim, n).astype(np.float32)
    value, found = made.gradient(case["steps"])(u0, np.zeros_like(u0))
    finite = bool(np.isfinite(value) and np.isfinite(found).all())
    return {"finite": finite, "norm": float(np.linalg.norm(found)) if finite else None}
