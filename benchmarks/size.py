"""Time per unknown and iteration: over the size of a sample, with one sample, and over the batch."""

from pathlib import Path

import torch

import prdp_torch as prdp
from benchmarks import measure

ITERATIONS = 10  # of Jacobi; GMRES(8) makes one cycle
SIDES = {
    "heat 1D, Jacobi": [(30,), (100,), (1000,), (10**4,), (10**5,), (10**6,), (10**7,)],
    "heat 2D, Jacobi": [(n, n) for n in (6, 16, 30, 64, 128, 256, 512, 1024, 2048, 3200)],
    "heat 3D, Jacobi": [(n, n, n) for n in (4, 8, 12, 20, 32, 64, 128, 215)],
    "Navier–Stokes, GMRES(8)": [(n, n) for n in (8, 16, 32, 48, 64, 96, 128, 256, 512)],
}
BATCHES = [1, 2, 5, 10, 25, 50, 100, 200, 500, 1000]
BATCH_SHAPES = {
    "heat 1D, Jacobi": (30,), "heat 2D, Jacobi": (30, 30), "heat 3D, Jacobi": (20, 20, 20),
    "Navier–Stokes, GMRES(8)": (32, 32),
}  # fmt: skip


def run(report, quick=False):
    """{"size": {series: points}, "batch": {series: points}, "caches": {name: bytes}}; a point's seconds are per
    unknown and iteration (a product with A for GMRES)."""
    largest = 10**5 if quick else 10**8
    by_size, by_batch = {}, {}
    for name, shapes in SIDES.items():
        report(f"cost against size: {name}")
        chosen = [shape for shape in shapes if torch.Size(shape).numel() <= largest]
        by_size[name] = [point(name, shape, 1) for shape in chosen]
    for name, shape in BATCH_SHAPES.items():
        report(f"cost against batch: {name}")
        by_batch[name] = [point(name, shape, batch) for batch in BATCHES[: 5 if quick else None]]
    return {"size": by_size, "batch": by_batch, "caches": caches()}


def caches():
    """Of one core, as Linux tells them; nothing elsewhere."""
    found = {}
    for cache in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        level, kind, size = ((cache / name).read_text().strip() for name in ("level", "type", "size"))
        if kind != "Instruction":
            found[f"L{level}"] = int(size.removesuffix("K")) * 1024
    return found


def point(name, shape, batch):
    states = torch.randn(batch, 3 if name.startswith("Navier") else 1, *shape)
    if name.startswith("Navier"):
        step = prdp.NavierStokes(shape, 1e-4, 0.1, solver=prdp.GMRES(1, rtol=0.0, restart=8))
        operator, b, solver, iterations = step.operator(states), step.rhs(states), prdp.GMRES(1, 0.0, restart=8), 8
    else:
        operator, b = prdp.operators.Heat(shape, 1e-3, 1.0), states
        solver, iterations = prdp.Jacobi(ITERATIONS, rtol=0.0), ITERATIONS
    call = lambda: prdp.linear_solve(operator, b, solver, backward="none", on_failure="return")  # noqa: E731
    _, info = call()
    residual = float(info.residual.max())
    seconds = measure.interleaved({0: call}, rounds=5)[0]
    work = b.numel() * iterations
    return {"unknowns": b[0].numel(), "batch": batch, "residual": residual, "seconds": seconds["min"],
            "per_unknown": seconds["min"] / work}  # fmt: skip
