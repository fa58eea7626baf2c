"""Steady conduction on 2 × 1: -∇·(k ∇T) = 0, T = 0 on the left, a flux of 1 in all on the right, none elsewhere.

The conductivity is k = k_min + (1 - k_min) rho³, one density rho per cell. The compliance is the integral of flux times
temperature over the right side. Everything is in float64.

- "exact": the compliance of a uniform and of a layered density beside its closed form
- "gradient": the gradient of the compliance beside central differences in 20 random directions
- "cost": seconds and peak memory of the compliance, and of it with its gradient
- "recovery": a density of two Gaussians from its temperatures, by L-BFGS from rho = 0.5"""

from typing import NamedTuple

import numpy as np

from benchmarks.mosaic import differences, optimise, readings

TITLE = "Conduction"
FAMILY = "conduction"

LAYERS = (0.9, 0.4, 0.7, 0.2)


class Plate(NamedTuple):
    nx: int
    k_min: float = 1e-3
    flux: float = 1.0

    @property
    def ny(self):
        return self.nx // 2

    @property
    def h(self):
        return 2.0 / self.nx

    def conductivity(self, rho):
        return self.k_min + (1 - self.k_min) * rho**3

    def conductivity_slope(self, rho):
        return 3 * (1 - self.k_min) * rho**2

    def centres(self):
        along = (np.arange(self.nx) + 0.5) * self.h
        return np.meshgrid(along, along[: self.ny])

    def layered(self):
        """Four layers from left to right."""
        x, _ = self.centres()
        return np.asarray(LAYERS)[(x * len(LAYERS) / 2).astype(int)]

    def layered_compliance(self):
        """The flux squared times the integral of 1/k along x."""
        return self.flux**2 * 2 / len(LAYERS) * sum(1 / self.conductivity(rho) for rho in LAYERS)

    def two_gaussians(self):
        x, y = self.centres()
        bumps = (np.exp(-((x - at) ** 2 + (y - 0.5) ** 2) / (2 * 0.15**2)) for at in (0.6, 1.4))
        return 0.4 + 0.5 * sum(bumps)

    def random(self, seed=0):
        return np.clip(0.5 + 0.3 * np.random.default_rng(seed).standard_normal((self.ny, self.nx)), 0.05, 0.95)


def cases(quick):
    if quick:
        return [{"what": what, "nx": 16, **more} for what, more in
                (("exact", {}), ("gradient", {}), ("cost", {}), ("recovery", {"iterations": 20}))]  # fmt: skip
    return [
        *({"what": "exact", "nx": nx} for nx in (16, 64)),
        *({"what": "gradient", "nx": nx} for nx in (16, 64)),
        *({"what": "cost", "nx": nx} for nx in (16, 32, 64, 128, 256, 512, 1024)),
        {"what": "recovery", "nx": 32, "iterations": 100},
    ]


def run(solver, case):
    return WHAT[case["what"]](solver, Plate(case["nx"]), case)


def exact(solver, plate, case):
    made, uniform = solver(plate), np.full((plate.ny, plate.nx), 0.5)
    truths = {"uniform": (uniform, plate.flux**2 * 2 / plate.conductivity(0.5)),
              "layered": (plate.layered(), plate.layered_compliance())}  # fmt: skip
    return {name: abs(made.compliance(rho)[0] / truth - 1) for name, (rho, truth) in truths.items()}


def gradient(solver, plate, case):
    made, rho = solver(plate), plate.random()
    _, found = made.compliance(rho)
    steps = [step for step in differences.STEPS if step <= 1e-2]  # larger ones make conductivities negative
    return differences.compare(made.forward, rho, found, directions=20, steps=steps)


def cost(solver, plate, case):
    solver(Plate(4)).compliance(Plate(4).random())  # what is loaded and set up once
    made, rho = solver(plate), plate.random()
    forward, _ = readings.of(lambda: made.forward(rho))
    both, _ = readings.of(lambda: made.compliance(rho))
    return {**{f"forward_{name}": value for name, value in forward.items()},
            **{f"gradient_{name}": value for name, value in both.items()}}  # fmt: skip


def recovery(solver, plate, case):
    made, truth = solver(plate), plate.two_gaussians()
    observed = made.temperatures(truth)
    scale = float((observed**2).sum())

    def misfit(rho):
        value, slope = made.misfit(rho, observed)
        return value / scale, slope / scale

    rho, losses = optimise.lbfgs(misfit, np.full_like(truth, 0.5), case["iterations"])
    return {
        "losses": losses,
        "error": float(np.linalg.norm(rho - truth) / np.linalg.norm(truth)),
        "start_error": float(np.linalg.norm(0.5 - truth) / np.linalg.norm(truth)),
    }


WHAT = {"exact": exact, "gradient": gradient, "cost": cost, "recovery": recovery}
