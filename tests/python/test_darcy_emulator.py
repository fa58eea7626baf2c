"""The scene darcy_emulator: its data against a dense solve, its gradient, its trainings in both languages."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import assert_refused, written

from prdp_torch import operators
from prdp_torch.experiments import _C, compare, scenes, trajectories
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

ROOT = Path(__file__).parents[2]
SMALL = (
    ("shape = [16, 16]", "shape = [5, 6]\nlength = [1.0, 2.0]"),
    ("train = 200", "train = 30"),
    ("valid = 20", "valid = 4"),
    ("hidden = [256, 256]", "hidden = [16]"),
    ("epochs = 60", "epochs = 4"),
)


def small(tmp_path, *changes):
    return written(tmp_path, *SMALL, *changes, scene="darcy_emulator", name="small")


def test_pressures_are_those_of_the_permeability_that_is_to_be_found(tmp_path):
    scene = scenes.load(small(tmp_path, ('"float32"', '"float64"')))
    data = _C.make_dataset(scene)
    assert data.train_start.shape == (30, 1, 5, 6) and torch.equal(data.train_start, data.train_end)
    matrices = operators.Diffusion(data.valid_end[:, 0].exp(), length=[1.0, 2.0]).dense()
    expected = np.linalg.solve(matrices, np.full((4, 30, 1), _C.DARCY_SOURCE))
    np.testing.assert_allclose(data.valid_start.reshape(4, 30, 1), expected, rtol=1e-10)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_the_gradient_of_log_kappa(tmp_path, backward):
    changes = [('"float32"', '"float64"'), ("rtol = 1e-5", "rtol = 1e-13"), ('"implicit"', f'"{backward}"')]
    step = scenes.make_stepper(scenes.load(small(tmp_path, *changes)))
    log_kappa = torch.randn(2, 1, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(step, log_kappa.requires_grad_(), eps=1e-5, atol=1e-8, rtol=1e-6)


@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize("arguments, refine", [(["--prdp"], Refinement.prdp), ([], lambda _: Refinement.auto())])
def test_both_languages_train_alike(tmp_path, arguments, refine, fresh):
    path = small(tmp_path, *([("seed = 0", "seed = 0\nfresh = true")] if fresh else []))
    scene = scenes.load(path)
    trainer = ROOT / "build" / "prdp_train"
    done = subprocess.run([trainer, path, "--out", tmp_path / "cpp", *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (record,) = (tmp_path / "cpp").glob("*/seed_0.json")
    cpp, python = json.loads(record.read_text())["curves"], train(scene, refine(scene))
    for name in ("update_loss", "metric", "rtol"):
        np.testing.assert_allclose(cpp[name], python[name], rtol=1e-3, err_msg=name)
    assert cpp["max_iter"] == python["max_iter"]


def test_the_network_finds_the_permeability_from_pressures_alone():
    scene = scenes.load("darcy_emulator")
    scene.training.intervals = 30
    metric = train(scene, Refinement.constant(2))["metric"]
    assert metric[0] > 0.9 and metric[-1] < 0.7


def test_there_are_no_trajectories_to_show(tmp_path):
    scene = scenes.load(small(tmp_path))
    assert trajectories.collect(scene, compare.rows_of(scene), tmp_path) is None


@pytest.mark.parametrize(
    "before, after, where, message",
    [
        ('equation = "darcy"', 'equation = "darcy"\ndt = 0.1', "dt =", "physics.dt: not for `poisson` and `darcy`"),
        ("modes = 1", "modes = 1\nvalid_steps = 2", "valid_steps", "data.valid_steps: not for `darcy`"),
        ("modes = 1", 'modes = 1\nfile = "x.npz"', "file =", "data.file: not for `darcy`"),
        ('"multigrid"', '"ilu"', "preconditioner", "unknown name 'ilu'; allowed: none, diagonal, multigrid"),
        (
            '"cg"',
            '"jacobi"',
            "preconditioner",
            "solver.preconditioner: only for `cg`, `bicgstab`, `gmres` and `minres`",
        ),
        ('"cg"', '"chebyshev"', "method", "solver.method: 'chebyshev' is only for `heat` and `poisson`"),
    ],
)
def test_mistakes_are_named_with_file_and_line(tmp_path, before, after, where, message):
    assert_refused(small(tmp_path, (before, after)), where, message)
