"""`prdp advise` on scenes, on steps with networks and parameters of their own, and as a command."""

import math
import re
import subprocess
import sys

import pytest
import torch
from helpers import field, small_darcy, small_field
from test_advise import advise

import prdp_torch as prdp
from prdp_torch.advice import network_seconds
from prdp_torch.experiments import scene_advice, scenes


def test_a_scene_says_what_share_its_physics_has():
    advice = scene_advice.advise_scene(scenes.load("heat_1d"), seconds=1.0)
    own = next(note for note in advice.notes if note.startswith("As the scene sets it"))
    share, physics, whole = map(float, re.search(r"(\d+)% of an update: (\S+) ms of (\S+) ms", own).groups())
    assert math.isclose(share, 100 * physics / whole, abs_tol=1.0) and "jacobi, K = 25, implicit" in own
    assert "physics is" in advice.recommendation and "Refinement" in advice.recommendation


@pytest.mark.parametrize("small, steps", [(small_field, 6), (small_darcy, 1)])
def test_a_scene_that_finds_a_field_is_advised_on(tmp_path, small, steps):
    advice = scene_advice.advise_scene(scenes.load(small(tmp_path)), seconds=0.2)
    assert "The field is the one that is to be found." in advice.notes
    assert any(f"makes {steps} steps with one A" in note for note in advice.notes) == (steps > 1)
    solved = [row for row in advice.rows if row.solved]
    assert {"CG", "Direct"} <= {row.name for row in solved}
    assert all(row.adjoint is not None and row.adjoint.products > 0 for row in solved)  # for the field alone, in Darcy
    assert re.match("(Use|Refine) .* (an update|a step) takes", advice.recommendation)


@pytest.mark.parametrize("channels", [1, 64])
def test_a_network_within_the_step_is_named(channels):
    torch.manual_seed(0)
    wide = torch.nn.Sequential(
        torch.nn.Conv1d(1, channels, 15, padding=7), torch.nn.ReLU(), torch.nn.Conv1d(channels, 1, 15, padding=7)
    ).double()
    heat = prdp.operators.Heat((1000,), 1e-3, 1e-3)
    network = wide if channels > 1 else None
    step = prdp.ImplicitStep(heat, network and (lambda u: u + 1e-3 * network(u)), prdp.CG(1))
    advice = advise(step, field((1000,), batch=8), seconds=0.1)
    told = [note for note in advice.notes if note.startswith("To make A(u) and b(u), and their gradients, takes")]
    assert len(told) == (channels > 1)
    if told:  # what the network takes by itself, of which the solves are a small part
        parts, whole = map(float, re.search(r"takes (\S+) ms of the (\S+) ms", told[0]).groups())
        alone = 1e3 * network_seconds(wide, field((1000,), batch=8), 1.0)
        assert 0.2 * alone < parts and 0.5 * parts < whole


def test_what_the_functions_of_a_step_close_over_gets_its_gradient():
    """Nothing in the step's `parameters()` asks for an adjoint solve."""
    kappa, b = torch.nn.Parameter(torch.ones(1, 16)), torch.ones(1, 1, 16)
    step = prdp.ImplicitStep(lambda u: prdp.operators.Diffusion(kappa.exp()), lambda u: b, prdp.CG(1))
    found = [row for row in advise(step, torch.zeros(1, 1, 16), seconds=0.1).rows if row.solved]
    assert found and all(row.adjoint is not None and row.adjoint.products > 0 for row in found)
    assert kappa.grad is None


def test_the_command_ends_with_a_recommendation(tmp_path):
    command = [sys.executable, "-m", "prdp_torch", "advise", "heat_1d", "--seconds", "1"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "Chebyshev" in done.stdout and "of an update" in done.stdout and not list(tmp_path.iterdir())
    assert re.match("(Use|Refine) .*it is (the fastest|as fast as any) to 1e-[25]", done.stdout.splitlines()[-1])
    assert max(map(len, done.stdout.split("Batch of")[0].splitlines())) <= 80 and "…" not in done.stdout
    wrong = subprocess.run([*command[:-1], "0"], cwd=tmp_path, capture_output=True, text=True)
    assert wrong.returncode == 2 and wrong.stderr == "prdp: advise: seconds must be a number > 0, got 0.0\n"
