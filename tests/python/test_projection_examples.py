"""The recipes of docs/flows.md run, and show what they say."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def numbers(name, *arguments):
    script = EXAMPLES / name
    assert len(script.read_text().splitlines()) <= 40
    done = subprocess.run([sys.executable, script, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return [float(word) for word in re.findall(r"-?\d+\.\d+(?:e-\d+)?|-?\d+", done.stdout)]


def test_the_drag_of_a_cylinder_and_its_gradient():
    drag, divergence, in_all, _ = numbers("flow_around_cylinder.py", 4, 100)
    assert 2 < drag < 4
    assert divergence < 1e-4
    assert in_all > 0  # more inflow, more drag


def test_the_lid_driven_cavity_beside_published_values():
    centre, error = numbers("lid_driven_cavity.py", 24, 100)
    assert centre == pytest.approx(-0.2058, abs=0.01)
    assert error < 0.01


def test_the_passive_scalar_is_conserved_and_traced_back():
    before, after, largest, *_, column, row = numbers("passive_scalar.py", 24, 20)
    assert after == pytest.approx(before, rel=1e-3)
    assert largest < 1
    assert column < 18 and abs(row - 12) <= 2  # from upstream of the probe


def test_the_network_holds_the_vortex():
    change, unforced, tolerance = numbers("force_network.py", 16, 40)
    assert change < 0.7 * unforced
    assert tolerance < 0.1
