"""The instruction sets that the inner loops are compiled for: all agree to rounding."""

import io
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import SOLVERS, field

import prdp_torch as prdp
from prdp_torch import operators

STENCILS = [
    ((33,), [(0,), (-1,), (1,)]),
    ((17,), [(0,), (-2,), (1,), (2,)]),
    ((5, 18), [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]),
    ((6, 30), [(0, 0), (2, -1), (-1, 2), (0, 1)]),
    ((3, 4, 17), [(0, 0, 0), (0, 0, -1), (0, 0, 1), (0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0)]),
]

SOLVE_ALL = """
import sys; sys.path.insert(0, {folder!r})
import io, torch
from test_cpu_levels import long_double_works, solve_all
buffer = io.BytesIO(); torch.save(solve_all(), buffer)
assert long_double_works(), "long double"
sys.stdout.buffer.write(buffer.getvalue())
"""


def solve_all():
    """Every method on stencils of each dimension and on a matrix, in both precisions."""
    results = {}
    for dtype in (torch.float32, torch.float64):
        for shape in ((33,), (17, 30), (5, 7, 18)):
            for solver in [*SOLVERS, prdp.Chebyshev]:
                u = prdp.Heat(shape, 1e-3, 1.0, solver=solver(7, rtol=0.0))(field(shape, dtype=dtype))
                results[str((dtype, shape, solver.__name__))] = u
        for shape, offsets in STENCILS:
            c = field(shape, dtype=dtype, channels=len(offsets))
            c[:, 0] = c.abs().sum(1) + 1
            a = operators.Stencil(c, offsets, "periodic")
            for solver in (prdp.Jacobi(7, rtol=0.0), prdp.GMRES(2, rtol=0.0, restart=4)):
                u = prdp.linear_solve(a, field(shape, dtype=dtype, channels=2), solver)[0]
                results[str((dtype, shape, len(offsets), solver.method))] = u
        m = torch.eye(19, dtype=dtype) * 3 + 0.1
        results[f"{dtype} matrix"] = prdp.linear_solve(m, field((19,), dtype=dtype)[:, 0], prdp.Jacobi(7))[0]
    return results


def long_double_works():
    """Not where code has left values in MMX registers, which are those of long double. LAPACK computes with it."""
    return float(np.longdouble(1) + np.longdouble(2)) == 3 and np.linalg.svd(np.eye(3))[1].tolist() == [1, 1, 1]


def at_level(level):
    code = SOLVE_ALL.format(folder=os.path.dirname(__file__))
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], env={**os.environ, "PRDP_CPU_LEVEL": level}, capture_output=True
    )


def test_every_level_gives_the_same_results_to_rounding():
    expected = solve_all()
    ran = []
    for level in ("baseline", "x86-64-v3", "x86-64-v4"):
        done = at_level(level)
        if done.returncode != 0:  # only what the processor lacks may be refused
            assert f"this processor has no level '{level}'" in done.stderr.decode() and level != "baseline"
            continue
        ran.append(level)
        results = torch.load(io.BytesIO(done.stdout), weights_only=True)
        for case, u in expected.items():
            rtol, atol = (1e-4, 1e-6) if u.dtype == torch.float32 else (1e-11, 1e-13)
            torch.testing.assert_close(results[case], u, rtol=rtol, atol=atol)
    assert "baseline" in ran


@pytest.mark.parametrize("level", ["baseline", "x86-64-v3"])
def test_hard_systems_are_solved_on_lower_levels_too(level):
    """What ends at rounding, as these systems do, ends elsewhere with other instructions."""
    folder = os.path.dirname(__file__)
    files = [os.path.join(folder, name) for name in ("test_gmres.py", "test_stability.py")]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, env={**os.environ, "PRDP_CPU_LEVEL": level}, capture_output=True, text=True)
    missing = level != "baseline" and f"this processor has no level '{level}'" in done.stdout
    assert done.returncode == 0 or missing, done.stdout


def test_an_unknown_level_is_named_with_those_that_exist():
    done = at_level("x86-64-v9")
    assert done.returncode != 0
    assert "PRDP_CPU_LEVEL: this processor has no level 'x86-64-v9'; allowed: baseline" in done.stderr.decode()


def test_no_code_for_one_processor_can_take_the_place_of_anothers():
    """What the linker may share between objects, as templates, has the name of the level in it."""
    objects = list(Path(__file__).parents[2].glob("build/**/prdp_loops_*.dir/**/*.o"))
    assert objects
    for path in objects:
        level = re.search(r"prdp_loops_(\w+)\.dir", str(path))[1]
        listed = subprocess.run(["nm", "-C", str(path)], capture_output=True, text=True, check=True).stdout
        shared = [line for line in listed.splitlines() if re.match(r"[0-9a-f]* *[uvVwW] ", line)]
        own = (f"Eigen_{level}::", "DW.ref.")  # the latter points to functions of the runtime
        assert not [line for line in shared if not any(name in line for name in own)], path
