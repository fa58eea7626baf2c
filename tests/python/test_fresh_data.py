"""`[data] fresh`: new training samples in every epoch, the same in both trainers and after a resume."""

import json
import subprocess
import time
from pathlib import Path

import pytest
import torch
from helpers import assert_refused, tiny, written

from prdp_torch.experiments import _C, checkpoint, records, scenes
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

TRAINER = Path(__file__).parents[2] / "build" / "prdp_train"
FRESH = ("valid = 5", "valid = 5\nfresh = true")
SHORT = ("epochs = 100", "epochs = 4")


def fresh_scene(tmp_path, *changes):
    return scenes.load(written(tmp_path, FRESH, SHORT, *changes))


def test_every_epoch_has_other_samples_that_follow_the_equation(tmp_path):
    scene = fresh_scene(tmp_path, ('dtype = "float32"', 'dtype = "float64"'))
    data = _C.make_dataset(scene)
    source = _C.FreshData(scene, data)
    epochs = [source.epoch(number) for number in (0, 1, 2, 1)]
    assert torch.equal(epochs[0].train_start, data.train_start) and torch.equal(epochs[0].train_end, data.train_end)
    assert torch.equal(epochs[1].train_end, epochs[3].train_end)
    every = torch.cat([epoch.train_start for epoch in epochs[:3]] + [data.valid_start])
    assert len(every.unique(dim=0)) == 3 * 200 + 5
    stepper = scenes.make_stepper(scene, direct=True)
    for epoch in epochs:
        torch.testing.assert_close(stepper(stepper(epoch.train_start)), epoch.train_end, rtol=1e-11, atol=1e-12)


def test_a_corrector_gets_its_first_step_too(tmp_path):
    scene = scenes.load(tiny(tmp_path, ("valid = 2", "valid = 2\nfresh = true")))
    data = _C.make_dataset(scene)
    source = _C.FreshData(scene, data)
    one, other = source.epoch(0), source.epoch(1)
    assert torch.equal(one.train_between, data.train_between)
    assert one.train_between[:, 0].shape == other.train_between[:, 0].shape == one.train_start.shape
    assert not torch.equal(one.train_between, other.train_between)


def test_the_end_does_not_wait_for_the_next_epoch(tmp_path):
    scene = scenes.load(tiny(tmp_path, ("valid = 2", "valid = 2\nfresh = true"), ("train = 8", "train = 600")))
    source = _C.FreshData(scene, _C.make_dataset(scene))
    started = time.monotonic()
    source.epoch(1)
    made = time.monotonic()
    del source
    assert time.monotonic() - made < 0.3 * (made - started)


def test_a_reference_that_does_not_converge_is_said_when_its_epoch_comes(tmp_path):
    first = _C.make_dataset(scenes.load(tiny(tmp_path)))
    scene = scenes.load(tiny(tmp_path, ("valid = 2", "valid = 2\nfresh = true"), ("dt = 0.1", "dt = 1e6"), name="long"))
    source = _C.FreshData(scene, first)
    for number in (1, 1, 2):
        with pytest.raises(RuntimeError, match="dt is too long"):
            source.epoch(number)


def test_a_resumed_training_sees_the_same_samples(tmp_path):
    scene = fresh_scene(tmp_path)
    whole = train(scene, Refinement.auto())

    def kept():
        return checkpoint.Checkpoint(tmp_path / "half", settings=records.identity(scene))

    train(scene, Refinement.auto(), checkpoint=kept(), callbacks=[lambda interval: interval.number == 2])
    rest = train(scene, Refinement.auto(), checkpoint=kept())
    assert rest["update_loss"] == whole["update_loss"] and rest["metric"] == whole["metric"]


def test_both_languages_train_alike(tmp_path):
    path = written(tmp_path, FRESH, SHORT)
    subprocess.run([TRAINER, path, "--constant", "3", "--out", tmp_path / "cpp"], check=True, capture_output=True)
    cpp = json.loads(next((tmp_path / "cpp").rglob("seed_0.json")).read_text())["curves"]
    python = train(scenes.load(path), Refinement.constant(3))
    assert cpp["update_loss"] == pytest.approx(python["update_loss"], rel=1e-4)
    assert cpp["metric"] == pytest.approx(python["metric"], rel=1e-4)


def test_what_does_not_go_together_is_refused(tmp_path):
    path = written(tmp_path, ("modes = 5               # sines and cosines 2πn, n = 1 … 5", 'file = "x.h5"'),
                   ("seed = 0\n", "fresh = true\n"))  # fmt: skip
    assert_refused(path, "fresh", "data.fresh: ")
    with pytest.raises(ValueError, match=r"a scene with data\.fresh makes its own data in every epoch"):
        train(fresh_scene(tmp_path), Refinement.auto(), data=torch.randn(300, 4, 1, 30))
