"""A guard against losing speed: the CPU loops beside the same iteration in plain tensors, as a ratio in one run.

The bounds are a quarter of what was measured: they trip when a kernel falls off its vector code or a loop
begins to allocate, not when a neighbour disturbs."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import prdp_torch as prdp
from benchmarks import measure, problems
from prdp_torch import _C

ROOT = Path(__file__).parents[2]

# problem, method: how many times as fast the loops are at least
BOUNDS = {
    ("heat_1d", "Jacobi"): 6,
    ("heat_2d", "Jacobi"): 8,
    ("heat_2d", "Chebyshev"): 8,
    ("heat_2d", "SteepestDescent"): 5,
    ("heat_2d", "CG"): 5,
    ("heat_3d", "Jacobi"): 4,
    ("burgers_1d", "GMRES"): 8,
    ("navier_stokes", "GMRES"): 5,
}


def ratio(name, method):
    problem = problems.PROBLEMS[name]()
    a, k = problem.operator, problem.k
    solver = problem.solver(k) if method == "GMRES" else getattr(prdp, method)(k, rtol=0.0)

    def loops():
        prdp.linear_solve(a, problem.b, solver, backward="none", on_failure="return")

    def tensors():
        spec = (a.tensors, a.kind, a.shape, a.parameters, False)
        _C.solve_with_tensors(problem.b, *spec, solver.method, k, 0.0, solver.restart)

    seconds = measure.interleaved({"loops": loops, "tensors": tensors}, rounds=3, sample_seconds=0.002)
    return seconds["tensors"]["min"] / seconds["loops"]["min"]


@pytest.fixture(scope="module")
def ratios():
    """Of one thread each, in a process of its own."""
    code = "import json, test_speed as t; print(json.dumps([t.ratio(*case) for case in t.BOUNDS]))"
    paths = os.pathsep.join([str(Path(__file__).parent), str(ROOT), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    return dict(zip(BOUNDS, json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("case", BOUNDS, ids="-".join)
def test_the_loops_are_faster_than_plain_tensors(case, ratios):
    assert ratios[case] > BOUNDS[case], f"only {ratios[case]:.1f} times as fast as plain tensors"
