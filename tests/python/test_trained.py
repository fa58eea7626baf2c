"""`load_trained`, and the modules that `import prdp_torch` brings along without importing them."""

import json
import subprocess
import sys

import pytest
import torch
from helpers import tiny, written

import prdp_torch as prdp
from prdp_torch.experiments import _C, compare, records, scenes
from prdp_torch.experiments.refinement import Refinement


def trained(scene, folder, *refinements, seeds=1):
    for refinement in refinements:
        for seed in range(seeds):
            compare.run_one(scene, refinement.label, refinement, seed, folder, records.environment())
    return folder


def heat(tmp_path, **changes):
    scene = scenes.load(written(tmp_path, *changes.items()))
    scene.training.intervals = 2
    return scene


def test_the_loaded_emulator_reaches_the_recorded_metric(tmp_path):
    scene = heat(tmp_path)
    folder = trained(scene, tmp_path / "run", Refinement.constant(3), seeds=2)
    data = _C.make_dataset(scene)
    for seed in (0, 1):
        emulator = prdp.load_trained(folder / "constant_3", seed=seed)
        with torch.no_grad():
            states = emulator.rollout(data.valid_start, 2)
            assert torch.equal(states[:, 1], emulator(data.valid_start))
        assert float(_C.normalised_mse(states[:, -1], data.valid_end)) == emulator.curves["metric"][-1]
        assert not emulator.network.training and emulator.scene.text == scene.text
    assert prdp.load_trained(str(folder)).curves == prdp.load_trained(folder / "constant_3").curves


def test_the_loaded_corrector_steps_the_coarse_solver_too(tmp_path):
    scene = scenes.load(tiny(tmp_path, ("epochs = 5", "epochs = 1")))
    corrector = prdp.load_trained(trained(scene, tmp_path / "run", Refinement.constant(2)))
    data = _C.make_dataset(scene)
    with torch.no_grad():
        reached = corrector.rollout(data.valid_start, 5)[:, -1]
    metric = float(_C.normalised_mse(reached[:, :1], data.valid_end[:, :1]))
    assert metric == pytest.approx(corrector.curves["metric"][-1], rel=1e-6)


def test_what_cannot_be_loaded_is_named(tmp_path):
    scene, folder = heat(tmp_path), tmp_path / "run"
    with pytest.raises(ValueError, match=r"no 'seed_0.json' in '.*run'; it holds no record"):
        prdp.load_trained(folder)
    trained(scene, folder, Refinement.constant(2), Refinement.constant(3))
    with pytest.raises(ValueError, match="several trainings; add one of constant_2, constant_3 to the path"):
        prdp.load_trained(folder)
    with pytest.raises(ValueError, match=r"no 'seed_7.json' in '.*constant_2'; it holds seed_0.json"):
        prdp.load_trained(folder / "constant_2", seed=7)
    (folder / "constant_2/seed_0.pt").unlink()
    with pytest.raises(ValueError, match=r"seed_0.pt', the weights that belong to the record, is missing"):
        prdp.load_trained(folder / "constant_2")
    (folder / "constant_3/seed_0.pt").write_bytes(b"other")
    with pytest.raises(ValueError, match="is damaged or not of the record beside it"):
        prdp.load_trained(folder / "constant_3")


def test_a_training_without_a_network_or_that_diverged_is_not_loaded(tmp_path):
    scene = scenes.load("poisson_1p")
    scene.training.intervals = 2
    with pytest.raises(ValueError, match="the scene 'poisson_1p' trains no network"):
        prdp.load_trained(trained(scene, tmp_path / "poisson", Refinement.constant(2)))
    wild = scenes.load(written(tmp_path, ("rate = 1e-3", "rate = 1e12"), name="wild"))
    with pytest.raises(ValueError, match="diverged, interval 1: the"):
        prdp.load_trained(trained(wild, tmp_path / "wild", Refinement.constant(2)))


def test_modules_for_trainings_come_with_the_package_when_they_are_used():
    code = (
        "import sys, json; import prdp_torch as prdp; before = [m in sys.modules for m in sys.argv[1:]];"
        "print(json.dumps([before, 'heat_1d' in prdp.experiments.scenes.available(), callable(prdp.load_trained),"
        " 'experiments' in dir(prdp)]))"
    )
    lazy = ("prdp_torch.experiments", "torch.utils.tensorboard", "matplotlib", "torch._dynamo")
    done = subprocess.run([sys.executable, "-c", code, *lazy], capture_output=True, text=True)
    assert json.loads(done.stdout) == [[False] * 4, True, True, True], done.stderr
    with pytest.raises(AttributeError, match="module 'prdp_torch' has no attribute 'nothing'"):
        prdp.nothing  # noqa: B018
