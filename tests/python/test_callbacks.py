"""Callbacks of the trainer, TensorBoard's among them."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from trainings import without_seconds

from prdp_torch.experiments import records, scenes
from prdp_torch.experiments.checkpoint import Checkpoint
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.tensorboard import TensorBoard
from prdp_torch.experiments.training import train

PRDP = [sys.executable, "-m", "prdp_torch"]


def short(intervals=6, name="heat_1d"):
    scene = scenes.load(name)
    scene.training.intervals = intervals
    return scene


def stop_at(number):
    return lambda interval: interval.number == number


@pytest.mark.parametrize("name, updates", [("heat_1d", 8), ("poisson_1p", 1)])
def test_a_callback_is_told_every_interval_as_the_curves_have_it(name, updates):
    scene, told = short(3, name), []
    curves = train(scene, Refinement.auto(), callbacks=[told.append])
    assert [interval.number for interval in told] == [1, 2, 3] and told[0].intervals == 3
    losses = np.reshape(curves["update_loss"], (3, updates))
    np.testing.assert_allclose([interval.loss for interval in told], losses.mean(1), rtol=1e-12)
    for name in ("metric", "error"):
        assert [getattr(interval, name) for interval in told] == curves[name][1:]
    for name in ("max_iter", "rtol", "iterations", "operator_applications", "adjoint_applications", "seconds"):
        assert [getattr(interval, name) for interval in told] == curves[name]
    with pytest.raises(AttributeError):
        told[0].metric = 0.0


def test_a_callback_that_returns_true_stops_the_training_and_all_are_called():
    scene, told = short(), []
    whole = train(scene, Refinement.constant(3))
    stopped = train(scene, Refinement.constant(3), callbacks=[stop_at(2), told.append, lambda interval: "no stop"])
    assert len(stopped["seconds"]) == len(told) == 2
    assert stopped["metric"] == whole["metric"][:3] and stopped["update_loss"] == whole["update_loss"][:16]


@pytest.mark.parametrize("true", [np.bool_(True), torch.tensor(True)])
def test_a_true_of_numpy_or_torch_stops_the_training_and_a_false_one_does_not(true):
    stop = lambda interval: true if interval.number == 2 else ~true  # noqa: E731
    assert len(train(short(4), Refinement.constant(3), callbacks=[stop])["seconds"]) == 2


def test_a_stopped_training_can_be_gone_on_with(tmp_path, monkeypatch):
    monkeypatch.setenv("PRDP_CHECKPOINT_SECONDS", "3600")  # none is due by itself
    scene, checkpoint = short(), Checkpoint(tmp_path / "kept")
    train(scene, Refinement.prdp(scene), callbacks=[stop_at(4)], checkpoint=checkpoint)
    again = train(scene, Refinement.prdp(scene), callbacks=[stop_at(4)], checkpoint=checkpoint)
    assert len(again["seconds"]) == 4  # it says so again when it is told the intervals that are done
    rest = train(scene, Refinement.prdp(scene), checkpoint=checkpoint)
    assert without_seconds(rest) == without_seconds(train(scene, Refinement.prdp(scene)))


class Exploding(torch.nn.Module):
    """Gives Inf after so many updates."""

    def __init__(self, updates):
        super().__init__()
        self.left = updates
        self.layer = torch.nn.Linear(30, 30)

    def forward(self, u):
        self.left -= torch.is_grad_enabled()
        return self.layer(u) * (1.0 if self.left >= 0 else torch.inf)


def test_a_callback_is_not_told_of_an_interval_that_was_lost():
    told = []
    curves = train(short(), Refinement.constant(3), network=Exploding(20), callbacks=[told.append])
    assert "interval 3: " in curves["diverged"] and [interval.number for interval in told] == [1, 2]


def test_what_is_no_callback_is_refused_before_any_work():
    with pytest.raises(TypeError, match="train: callbacks must be functions of an Interval, got 3"):
        train(short(), Refinement.constant(3), callbacks=[3])
    with pytest.raises(TypeError, match="train: callbacks must be a list of functions, got <built-in function print>"):
        train(short(), Refinement.constant(3), callbacks=print)


# ---- TensorBoard


def scalars(folder):
    """{tag: [(step, value), …]} as TensorBoard would show them."""
    events = EventAccumulator(str(folder)).Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_the_command_writes_what_tensorboard_shows(tmp_path):
    command = [*PRDP, "train", "heat_1d", "--constant", "4", "--intervals", "3", "--out", "here", "--tensorboard"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    curves = records.read(tmp_path / "here/constant_4/seed_0.json")["curves"]
    shown = scalars(tmp_path / "here/constant_4/seed_0.tensorboard")
    assert [step for step, _ in shown["training/metric"]] == [1, 2, 3]
    np.testing.assert_allclose([value for _, value in shown["training/metric"]], curves["metric"][1:], rtol=1e-6)
    np.testing.assert_allclose(
        [value for _, value in shown["solver/products"]], curves["operator_applications"], rtol=1e-6
    )
    assert [value for _, value in shown["solver/max_iter"]] == [4, 4, 4]


def test_a_resumed_training_shows_every_interval_once(tmp_path, monkeypatch):
    monkeypatch.setenv("PRDP_CHECKPOINT_SECONDS", "0")
    scene, checkpoint = short(4), Checkpoint(tmp_path / "kept")
    for last in (2, 4):
        callbacks = [TensorBoard(tmp_path / "events"), stop_at(last)]
        train(scene, Refinement.constant(3), callbacks=callbacks, checkpoint=checkpoint)
    assert [step for step, _ in scalars(tmp_path / "events")["training/loss"]] == [1, 2, 3, 4]


def test_a_missing_tensorboard_is_one_line(tmp_path):
    code = "import sys; sys.modules['tensorboard'] = None; from prdp_torch.experiments.cli import main; main()"
    command = [sys.executable, "-c", code, "train", "heat_1d", "--tensorboard", "--out", "here"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and not list(tmp_path.rglob("*.json"))
    assert done.stderr == "prdp: TensorBoard: the package tensorboard is missing; pip install tensorboard\n"
