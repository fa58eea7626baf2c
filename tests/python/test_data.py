"""Data and networks of one's own: tensors, files in PDEBench's layout, and what is said of a mismatch."""

import math
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from helpers import tiny, written
from trainings import without_seconds

from prdp_torch.experiments import _C, compare, datasets, pdebench, records, scenes, trajectories
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

PRDP = [sys.executable, "-m", "prdp_torch"]
TRAINER = Path(__file__).parents[2] / "build" / "prdp_train"
FROM_FILE = ("modes = 5               # sines and cosines 2πn, n = 1 … 5", 'file = "x.h5"'), ("seed = 0\n", "")
SMALL = ("train = 200", "train = 50"), ("epochs = 100", "epochs = 3")


def heat(tmp_path, *changes):
    return scenes.load(written(tmp_path, *SMALL, *changes, name="made"))


def heat_from_file(tmp_path, *changes):
    return scenes.load(written(tmp_path, *SMALL, *FROM_FILE, *changes, name="read"))


def random_trajectories(scene, times=3, samples=None):
    samples = samples or scene.data.train + scene.data.valid
    return torch.randn(samples, times, scene.physics.channels, *scene.physics.shape)


# ---- files


@pytest.mark.parametrize("name, shape, tensor", [("heat_3d", [4, 5, 6], (6, 5, 4)), ("burgers_2d", [6, 8], (8, 6, 2))])
def test_files_have_x_first_and_channels_last(tmp_path, name, shape, tensor):
    large = {"heat_3d": "[20, 20, 20]", "burgers_2d": "[96, 96]"}[name]
    train = {"heat_3d": "train = 200", "burgers_2d": "train = 400"}[name]
    scene = scenes.load(written(tmp_path, (large, str(shape)), (train, "train = 3"), scene=name))
    states = random_trajectories(scene)
    pdebench.write(tmp_path / "x.h5", states, scene)
    with h5py.File(tmp_path / "x.h5") as file:
        assert file["tensor"].shape == (3 + scene.data.valid, 3, *tensor)
        last = (1, 2, 0, *(n - 1 for n in shape))
        x_first = (1, 2, *(n - 1 for n in reversed(shape)), 0)
        assert file["tensor"][x_first[: file["tensor"].ndim]] == states[last]
        assert [len(file[f"{axis}-coordinate"]) for axis in "xyz"[: len(shape)]] == list(reversed(shape))
    assert torch.equal(pdebench.read(tmp_path / "x.h5", scene), states)


def test_a_file_as_pdebench_has_it_is_read(tmp_path):
    """float32 coordinates, of which t has the edges; cell centres in x; more samples and times than are used."""
    scene = scenes.load(
        written(tmp_path, ("shape = [256]", "shape = [16]"), ("train = 200", "train = 4"), scene="burgers_1d")
    )
    states = random_trajectories(scene, times=21, samples=30)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["tensor"] = states[:, :, 0].numpy()
        file["x-coordinate"] = ((np.arange(16) + 0.5) / 16).astype(np.float32)
        file["t-coordinate"] = (np.arange(22) * scene.physics.dt).astype(np.float32)
    assert torch.equal(pdebench.read(tmp_path / "x.h5", scene), states[: 4 + scene.data.valid])


def test_a_file_with_too_few_times_is_refused(tmp_path):
    scene = heat_from_file(tmp_path, ("valid_steps = 2", "valid_steps = 5"))
    pdebench.write(tmp_path / "x.h5", random_trajectories(scene, times=5), scene)
    with pytest.raises(ValueError, match="validation trajectories need 6 times, for 5 steps, but the data have 5"):
        train(scene, Refinement.constant(3))


@pytest.mark.parametrize("content, message", [(None, "no such file"), (b"not HDF5", "file signature not found")])
def test_what_is_no_file_of_trajectories_is_one_line_of_the_command(tmp_path, content, message):
    scene = heat_from_file(tmp_path)
    if content:
        (tmp_path / "x.h5").write_bytes(content)
    done = subprocess.run([*PRDP, "train", scene.path, "--out", "here"], cwd="/", capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert f"prdp: data: cannot read '{tmp_path}/x.h5'" in done.stderr or message in done.stderr


def test_a_missing_h5py_is_one_line(tmp_path):
    code = "import sys; sys.modules['h5py'] = None; from prdp_torch.experiments.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, "export", "heat_1d", "--out", "x.h5"], cwd=tmp_path,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 2 and not (tmp_path / "x.h5").exists()
    assert done.stderr.endswith("data: HDF5 files need the package h5py; pip install h5py, or take an .npz file\n")


def test_the_cpp_trainer_refuses_a_file(tmp_path):
    scene = heat_from_file(tmp_path)
    pdebench.write(tmp_path / "x.h5", random_trajectories(scene), scene)
    done = subprocess.run([TRAINER, scene.path, "--out", tmp_path / "cpp"], capture_output=True, text=True)
    assert done.returncode == 2
    words = f"data.file: only prdp train and prdp compare read it, with the states of {scene.path}\n"
    assert done.stderr.endswith(words)


@pytest.mark.parametrize("zeros", [slice(None), slice(3, 4), slice(51, 52)])
def test_states_of_zeros_that_errors_would_be_divided_by_are_refused(tmp_path, zeros):
    scene = heat(tmp_path)
    trajectories = random_trajectories(scene, 4)
    trajectories[zeros] = 0
    what = {3: "training trajectory 3", 51: "validation trajectory 1"}.get(zeros.start, "validation trajectory 0")
    with pytest.raises(ValueError, match=f"train: {what} is zero after 2 steps; errors are relative to it"):
        train(scene, Refinement.prdp(scene), data=trajectories)


def test_keys_of_made_data_do_not_go_with_a_file(tmp_path):
    with pytest.raises(ValueError, match=r"data\.modes: only for `emulator`, not with `file`"):
        scenes.load(written(tmp_path, ("modes = 5 ", 'file = "x.h5"\nmodes = 5 '), ("seed = 0\n", "")))


def test_a_comparison_from_a_file_shows_what_the_file_has_and_resumes_with_it_alone(tmp_path):
    scene = heat_from_file(tmp_path, ("constant = [1, 2, 3, 5, 7, 10, 15, 25]", "constant = []"), ("growth = 1.5", ""))
    datasets.export(heat(tmp_path), tmp_path / "x.h5", steps=4)
    run = tmp_path / "run"
    rows = compare.run(scene, 1, run)
    shown = trajectories.collect(scene, rows, run)
    assert shown.reference.shape == (5, 5, 1, 30)  # the file ends before four times the horizon
    followed = [row for row in rows if row.kind in ("converged", "auto", "prdp")]
    for course, row in zip(shown.courses, followed, strict=True):
        assert course.errors[0, 1] == pytest.approx(row.final()[0], rel=1e-6)
    record = run / "prdp/seed_0.json"
    before = record.stat().st_mtime_ns
    compare.run(scene, 1, run, resume=True)
    assert record.stat().st_mtime_ns == before
    datasets.export(heat(tmp_path, ("seed = 0", "seed = 1")), tmp_path / "x.h5", steps=4)
    compare.run(scene, 1, run, resume=True)
    assert record.stat().st_mtime_ns > before and records.read(record)["settings"]["data"]


# ---- tensors


def test_tensors_and_datasets_train_as_the_file_does(tmp_path):
    scene = heat(tmp_path)
    states = _C.all_trajectories(scene, 2)
    wanted = without_seconds(train(scene, Refinement.constant(5)))
    pair = (states[:50], states[50:])
    for own in (states, states.numpy(), states.double(), torch.utils.data.TensorDataset(states), pair):
        assert without_seconds(train(scene, Refinement.constant(5), data=own)) == wanted


def test_every_state_of_a_longer_trajectory_is_a_start(tmp_path):
    scene = heat(tmp_path)
    states = torch.arange(55 * 6.0).reshape(55, 6, 1, 1).expand(55, 6, 1, 30)
    data = datasets.of_scene(scene, states)
    first = data.train_start[:, 0, 0]
    assert len(first) == 50 * 4 and set(first.tolist()) == {6.0 * i + t for i in range(50) for t in range(4)}
    assert torch.equal(data.train_between[:, 0], data.train_start + 1) and torch.equal(
        data.train_end, data.train_start + 2
    )
    assert torch.equal(data.valid_start, states[50:, 0]) and torch.equal(data.valid_end, states[50:, 2])


def test_a_corrector_takes_trajectories_too(tmp_path):
    scene = scenes.load(tiny(tmp_path, ("epochs = 5", "epochs = 1")))
    states = _C.all_trajectories(scene, 5)
    made = datasets.of_scene(scene)
    own = datasets.of_scene(scene, (states[:8, :3], states[8:]))
    for name in ("train_start", "train_between", "train_end", "valid_start", "valid_end"):
        torch.testing.assert_close(getattr(own, name), getattr(made, name), rtol=0, atol=0)
    assert math.isfinite(train(scene, Refinement.constant(2), data=states)["metric"][-1])


@pytest.mark.parametrize(
    "own, kind, message",
    [
        (torch.zeros(55, 3, 30), ValueError, r"data must have shape \(samples, times, 1, 30\), got \(55, 3, 30\)"),
        (torch.zeros(20, 3, 1, 30), ValueError, "has 20 trajectories; data.train . data.valid of the scene is 55"),
        (torch.zeros(55, 2, 1, 30), ValueError, "training trajectories need 3 times, for 2 steps, but the data have 2"),
        (torch.zeros(55, 3, 1, 30, dtype=torch.int64), TypeError, "data must hold floating-point numbers"),
        (torch.full((55, 3, 1, 30), torch.inf), ValueError, "train: data: trajectory 0 holds NaN or Inf"),
        ((torch.zeros(5, 3, 1, 30),), ValueError, "data must be trajectories, or a pair"),
        ((torch.zeros(5, 3, 1, 30), torch.zeros(5, 3, 1, 7)), ValueError, r"data\[1\] must have shape"),
        ("x.h5", TypeError, "data must be trajectories as a tensor, got str"),
    ],
)
def test_data_that_does_not_fit_is_refused_in_words(tmp_path, own, kind, message):
    with pytest.raises(kind, match=message):
        train(heat(tmp_path), Refinement.constant(3), data=own)


def test_data_is_refused_where_no_network_is_trained():
    scene = scenes.load("poisson_1p")
    for own in ({"data": torch.zeros(1)}, {"network": torch.nn.Linear(3, 3)}):
        with pytest.raises(ValueError, match="the task 'parameters' trains no network: it takes no data, and as"):
            train(scene, Refinement.constant(3), **own)


# ---- networks


class Counting(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.norm = torch.nn.BatchNorm1d(1)
        self.conv = torch.nn.Conv1d(1, 1, 3, padding=1)
        self.frozen = torch.nn.BatchNorm1d(1).eval()

    def forward(self, u):
        return self.conv(self.frozen(self.norm(u)))


def test_the_trial_of_a_network_leaves_it_as_it_is(tmp_path):
    network = Counting()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    torch.manual_seed(3)
    state = torch.get_rng_state()
    datasets.check_network(heat(tmp_path), network, torch.randn(1, 1, 30, generator=torch.Generator()))
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    assert network.norm.training and not network.frozen.training and torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize(
    "network, kind, message",
    [
        (lambda u: u, TypeError, "network must be a torch.nn.Module, got function"),
        (torch.nn.Identity(), ValueError, "network has no parameters that require a gradient"),
        (torch.nn.Linear(30, 20), ValueError, r"keep the shape of its input, \(1, 1, 30\), got \(1, 1, 20\)"),
        (torch.nn.Linear(20, 20), ValueError, r"network fails on states \(1, 1, 30\): mat1 and mat2 shapes cannot"),
        (torch.nn.Linear(30, 30).double(), ValueError, r"computes in float32, but network has parameters in float64; "),
        (torch.nn.LSTM(30, 30), ValueError, "got tuple"),
    ],
)
def test_a_network_that_does_not_fit_is_refused_in_words(tmp_path, network, kind, message):
    with pytest.raises(kind, match=message):
        train(heat(tmp_path), Refinement.constant(3), network=network)
