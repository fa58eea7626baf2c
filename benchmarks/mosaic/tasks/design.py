"""The drag of a cylinder, lowered by the profile of the inflow.

A box of side 1, periodic in x, walls in y, a cylinder of radius .05 in its middle. Before every step the first column
is set to the profile (its other component to zero). The drag of a step is the sum over the faces between fluid and
solid along x: p h - nu u upstream, minus the same downstream, with p in the fluid cell and u in its middle. It is
averaged over the last half of the steps. Adam changes the profile, from a flat one; a penalty keeps its mean.

The sign of nu u is that of the benchmark's definition. On a body, friction would add to the pressure upstream."""

from typing import NamedTuple

import numpy as np

from benchmarks.mosaic import optimise
from benchmarks.mosaic.solvers import Box

TITLE = "Design of an inflow"
FAMILY = "flow"
ABILITY = "design"

PENALTY, LEARNING_RATE = 50.0, 5e-4


class Cylinder(NamedTuple):
    n: int = 32
    steps: int = 200
    nu: float = 0.0025
    dt: float = 0.02
    speed: float = 0.5
    radius: float = 0.05

    def solid(self):
        """Cells whose middle is in the cylinder."""
        middle = (np.arange(self.n) + 0.5) / self.n - 0.5
        return middle[:, None] ** 2 + middle**2 < self.radius**2

    def box(self):
        return Box((self.n, self.n), self.nu, self.dt, 1.0, "channel", self.solid())

    def start(self, offsets):
        """The flat profile everywhere, at rest on faces of solid cells (u on low or high faces of x)."""
        solid = self.solid()
        closed = solid | np.roll(solid, 1 if offsets[0][-1] == 0.0 else -1, -1)
        return np.stack([np.where(closed, 0.0, self.speed), np.zeros(solid.shape)])

    def drag(self, u, pressure):
        """From the velocity along x and the pressure in the middle of the cells; arrays of any library."""
        upstream, downstream = self.faces()
        weights = upstream.astype(float) - downstream
        if not isinstance(u, np.ndarray) and hasattr(u, "new_tensor"):
            weights = u.new_tensor(weights)
        return (weights * pressure).sum() / self.n - self.nu * (weights * u).sum()

    def faces(self):
        """The fluid cells right before and right behind a solid one."""
        solid = self.solid()
        return ~solid & np.roll(solid, -1, 1), ~solid & np.roll(solid, 1, 1)


def cases(quick):
    return [{"n": 32, "steps": 40 if quick else 200, "iterations": 3 if quick else 250}]


def run(solver, case):
    cylinder = Cylinder(case["n"], case["steps"])
    mean_drag = solver(cylinder.box()).mean_drag(cylinder)
    drags = []

    def loss(profile):
        drag, slope = mean_drag(profile)
        if not (np.isfinite(drag) and np.isfinite(slope).all()):
            raise FloatingPointError(f"the drag or its gradient is not finite after {len(drags)} iterations")
        drags.append(float(drag))
        excess = profile.mean() - cylinder.speed
        return drag + PENALTY * excess**2, slope + 2 * PENALTY * excess / profile.size

    profile, losses = optimise.adam(loss, np.full(case["n"], cylinder.speed), case["iterations"], LEARNING_RATE)
    return {
        "drags": [float(f"{drag:.4g}") for drag in drags],
        "losses": [float(f"{value:.4g}") for value in losses],
        "profile": [float(f"{value:.4g}") for value in profile],
    }
