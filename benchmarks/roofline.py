"""What an iteration reaches of what this machine allows: arithmetic, and reads from the level of memory
that holds a sample."""

import json
import subprocess
import tempfile
from pathlib import Path

from benchmarks import measure, ours
from benchmarks.problems import PROBLEMS

BYTES = 4
SOURCE = Path(__file__).parent / "limits.cpp"


def run(report, quick=False):
    """{"limits": …, "points": […]}: per point floating-point operations and bytes moved, counted below."""
    report("limits of this machine")
    limits = machine_limits()
    found = []
    for make in PROBLEMS.values():
        problem = make()
        report(f"roofline: {problem.title}")
        for label, (solver, _) in ours.methods(problem).items():
            if label in COUNTS:
                found.append(point(problem, label, solver, quick))
    return {"limits": limits, "points": found}


def machine_limits():
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "limits"
        subprocess.run(["g++", "-O3", "-march=native", "-std=c++20", SOURCE, "-o", program], check=True)
        return json.loads(subprocess.run([program], check=True, capture_output=True, text=True).stdout)


def point(problem, label, solver, quick):
    forward, _ = ours.calls(problem, solver(problem.k), "implicit")
    seconds = measure.interleaved({0: forward}, rounds=3 if quick else measure.ROUNDS)[0]["min"]
    dim = len(problem.shape)
    operations, vectors = COUNTS[label](dim, problem)
    values = problem.b.numel() * problem.k
    return {
        "problem": problem.title, "label": label, "k": problem.k, "seconds": seconds,
        "residual": problem.errors(forward())[0],
        "sample_bytes": problem.unknowns * BYTES * VECTORS_HELD.get(label, 4),
        "gflops": operations * values / seconds / 1e9,
        "gb_per_s": vectors * BYTES * values / seconds / 1e9,
    }  # fmt: skip


def _gmres(dim, problem):
    """A cycle of m products: the stencil, j + 1 dots and as many subtractions after product j, the update."""
    m = problem.solver(1).restart
    product = 4 * dim + 3
    gram_schmidt = sum(4 * (j + 1) for j in range(m))
    vectors = m * (2 + 2 * dim) + sum(2 * (j + 1) + 3 for j in range(m)) + m + 2
    return m * (product + 4) + gram_schmidt + 2 * m, vectors


# Operations and vectors read or written, per unknown and iteration.
COUNTS = {
    "Jacobi": lambda dim, problem: (2 * dim + 1, 3),
    "Chebyshev": lambda dim, problem: (2 * dim + 4, 4),
    "steepest descent": lambda dim, problem: (2 * dim + 2 + 8, 8),
    "CG": lambda dim, problem: (2 * dim + 2 + 10, 9),
    "GMRES(2)": _gmres,
    "GMRES(8)": _gmres,
}
VECTORS_HELD = {"Jacobi": 3, "GMRES(2)": 10, "GMRES(8)": 18}
