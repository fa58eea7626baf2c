"""Trainings under bad physics: failed samples are counted and named, and controllers say what they see."""

import importlib.util
import json
import math
import subprocess
from pathlib import Path

import pytest
import torch
from helpers import assert_refused, tiny, written

import prdp_torch as prdp
from prdp_torch.experiments import _C, scenes
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

ROOT = Path(__file__).parents[2]


def example():
    spec = importlib.util.spec_from_file_location("diverging_start", ROOT / "examples" / "diverging_start.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_training_that_starts_in_a_diverging_regime_recovers():
    module = example()
    with pytest.raises(torch.linalg.LinAlgError, match="4 of 8 samples failed: sample 4 DIVERGED"):
        module.train("raise", updates=1)
    theta, failed = module.train("zero_grad")
    assert failed[0] == 4 and failed[-20:] == [0] * 20 and abs(theta) < 0.02


# ---- the trainers


def diverging(tmp_path, way):
    """A small corrector whose solver, steepest descent, diverges on some flows."""
    changes = (
        ('method = "gmres"', f'method = "steepest_descent"\non_failure = "{way}"'),
        ("restart = 8 ", "# "),
        ("max_iter = 44", "max_iter = 300"),
        ("valid_max_iter = 120", "valid_max_iter = 5"),
    )
    return tiny(tmp_path, *changes, name=f"wild_{way}")


def run_in_cpp(path, tmp_path):
    command = [ROOT / "build" / "prdp_train", path, "--constant", "300", "--out", tmp_path / "cpp"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads((tmp_path / "cpp/constant_300/seed_0.json").read_text())["curves"], done.stderr


@pytest.mark.parametrize("way", ["return", "zero_grad"])
def test_both_trainers_count_and_name_failed_samples(tmp_path, capsys, way):
    path = diverging(tmp_path, way)
    curves = train(scenes.load(path), Refinement.constant(300))
    lines = [line for line in capsys.readouterr().err.splitlines() if "failed sample" in line]
    assert len(lines) == 5 and all(0 < n <= 8 for n in curves["failed"])
    begin = f"prdp: wild_{way}, constant_300, seed 0, interval 1: {curves['failed'][0]} failed samples: sample "
    assert lines[0].startswith(begin) and "DIVERGED in the forward solve" in lines[0]
    cpp, said = run_in_cpp(path, tmp_path)
    assert cpp["failed"][0] == curves["failed"][0]
    assert lines[0].replace("prdp:", "prdp_train:") in said.splitlines()


def test_a_batch_goes_on_past_nan_with_zero_grad_alone(tmp_path, capsys):
    """Networks that hand NaN to the solver for one sample of the data."""

    class Spoilt(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.shift = torch.nn.Parameter(torch.zeros(1))

        def forward(self, u):
            first = u.flatten(1)[:, 0] == spoilt
            return u + self.shift + torch.where(first, torch.nan, 0.0).view(-1, 1, 1).detach()

    for way, ends in (("return", True), ("zero_grad", False)):
        changes = (
            ('backward = "implicit"', f'backward = "implicit"\non_failure = "{way}"'),
            ("epochs = 100", "epochs = 2"),
        )
        scene = scenes.load(written(tmp_path, *changes, name=way))
        spoilt = _C.make_dataset(scene).train_start.flatten(1)[7, 0]
        network = Spoilt()
        curves = train(scene, Refinement.constant(5), network=network)
        assert ("diverged" in curves) == ends
        said = capsys.readouterr().err
        if not ends:
            assert curves["failed"] == [1, 1] and torch.isfinite(network.shift).all() and network.shift != 0.0
            assert "interval 2: 1 failed sample: sample 7 NONFINITE_INPUT in the forward solve" in said


def test_the_key_of_a_scene_knows_two_ways(tmp_path):
    assert scenes.load("heat_1d").on_failure == "return"
    bad = written(tmp_path, ('backward = "implicit"', 'backward = "implicit"\non_failure = "raise"'))
    assert_refused(bad, "on_failure", "solver.on_failure: unknown name 'raise'; allowed: return, zero_grad")


def failures(*updates):
    counted = _C.Failures()
    for forward, adjoint, samples in updates:
        counted.take([torch.tensor(s) for s in forward], [torch.tensor(s) for s in adjoint], torch.tensor(samples))
    return counted


def test_failures_are_named_by_their_number_among_the_data():
    counted = failures(([[1, -3, 1]], [[1, -3, -5]], [4, 7, 9]), ([[1, -1, -2]], [[1, 1, 1]], [1, 2, 3]))
    assert counted.count == 2
    assert counted.line(12) == (
        "interval 12: 2 failed samples: sample 7 DIVERGED in the forward solve, sample 9 BREAKDOWN in the adjoint solve"
    )
    assert failures(([[1, -2]], [], [0, 1])).line(3) == ""
    rollout = failures(([[[1, -1], [1, -4]], [[1, 1], [1, 1]]], [], [5, 6]))  # two solvers, two steps
    assert rollout.line(1) == "interval 1: 1 failed sample: sample 6 OVERFLOW in the forward solve"
    assert (
        failures(([[-3] * 9], [], list(range(9))))
        .line(2)
        .endswith("sample 3 DIVERGED in the forward solve, and 5 more")
    )


# ---- the controllers

CONTROLLERS = [lambda: prdp.PRDPController(initial=3), lambda: prdp.ToleranceController()]


def metric_of(controller):
    return "error" if isinstance(controller, prdp.ToleranceController) else "metric"


@pytest.mark.parametrize("make", CONTROLLERS)
@pytest.mark.parametrize("metric", [math.nan, math.inf, -1.0])
def test_a_metric_that_is_no_number_is_refused_changes_nothing_and_is_said(make, metric):
    controller = make()
    controller.step(0.5)
    before = controller.state_dict()
    with pytest.raises(ValueError, match=f"must be finite and >= 0, got {metric:g}"):
        controller.step(metric)
    assert controller.state_dict() == before
    name, what = type(controller).__name__, metric_of(controller)
    assert controller.warning.startswith(f"{name}: the last {what} was {metric:.1e}, and nothing was changed. Go back")
    controller.step(0.4)
    assert controller.warning is None


@pytest.mark.parametrize("make", CONTROLLERS)
def test_a_metric_that_grows_is_said(make):
    controller = make()
    for metric in (1.0, 0.2, 0.1, 0.5, 0.6):
        controller.step(metric)
        assert controller.warning is None
    controller.step(0.7)
    said = "7.0e-01 after 1.0e-01 in interval 2; lower the learning rate, solve further"
    assert controller.warning.startswith(f"{type(controller).__name__}: the {metric_of(controller)} grows: {said}")
    controller.step(0.15)
    assert controller.warning is None


def test_what_controllers_do_with_a_growing_metric():
    """PRDPController refines, as its docstring says; ToleranceController keeps the smallest error's tolerance."""
    controller = prdp.PRDPController(delta=2, window=1, initial=3)
    raised = [controller.step(metric) for metric in (1.0, 0.5, 0.5, 0.5, 0.9, 2.0)]
    assert raised == [False, False, True, False, True, True] and controller.max_iter == 6
    tolerance = prdp.ToleranceController()
    rtol = []
    for error in (0.5, 0.1, 0.4, 0.9):
        tolerance.step(error)
        rtol.append(tolerance.rtol)
    assert rtol == sorted(rtol, reverse=True) and rtol[1] == rtol[-1] == pytest.approx(0.01)


def test_rounding_is_no_growth():
    controller = prdp.PRDPController()
    for metric in (1.0, 1e-3, 1e-8, 5e-8, 3e-8, 4e-8):
        controller.step(metric)
    assert controller.warning is None
