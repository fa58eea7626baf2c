"""Files that were damaged or forged: each is refused in one line that names it, and none runs code."""

import io
import os
import random
import subprocess

import pytest
import torch
from helpers import reseal, tiny
from test_files import HEAT, TRAINER, TRAINERS, run, short
from trainings import checkpoint_of, frequent_checkpoints, restored, state  # noqa: F401, a fixture of every test here

from prdp_torch.experiments import _C, compare, records, scenes
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement


def trained(scene, folder, resume=False):
    environment = records.environment()
    return compare.run_one(scene, "prdp", Refinement.prdp(scene), 0, folder, environment, resume)


def damages(whole, count):
    """Copies with a few bytes changed, cut short, or with something inserted."""
    dice = random.Random(0)
    for i in range(count):
        at = dice.randrange(len(whole))
        if i % 4 == 0:
            yield whole[:at]
        elif i % 4 == 1:
            yield whole[:at] + dice.randbytes(dice.randrange(1, 9)) + whole[at:]
        else:
            changed = bytearray(whole)
            for _ in range(dice.randrange(1, 5)):
                changed[dice.randrange(len(whole))] ^= 1 << dice.randrange(8)
            yield bytes(changed)


def refused(path, read, count=300):
    """Every damaged copy of the file is refused in one line that names it."""
    whole = path.read_bytes()
    for damaged in damages(whole, count):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=f"'{path}' is damaged or ") as error:
            read()
        assert "\n" not in str(error.value)
    path.write_bytes(whole)
    read()


# ---- damage


def test_damaged_data_are_refused(tmp_path):
    scene = scenes.load(tiny(tmp_path))
    _C.make_dataset(scene)
    (file,) = (tmp_path / "cache").iterdir()
    refused(file, lambda: _C.make_dataset(scene))


def test_damaged_records_and_weights_are_refused(tmp_path):
    scene = short()
    curves = trained(scene, tmp_path)
    record, weights = (tmp_path / "prdp" / f"seed_0.{kind}" for kind in ("json", "pt"))
    refused(record, lambda: records.read(record))
    network = make_network(scene, 0)
    refused(weights, lambda: records.read_weights(record, network))
    assert trained(scene, tmp_path, resume=True) == curves


def test_damaged_checkpoints_are_refused(tmp_path):
    checkpoint = checkpoint_of(tmp_path / "kept")
    checkpoint.save(*state(1, torch.randn(50)))
    refused(tmp_path / "kept", checkpoint.find)


@pytest.mark.parametrize("trainer", TRAINERS)
@pytest.mark.parametrize("content", ["{}", "null", "", None])
def test_what_is_no_record_is_one_line(tmp_path, trainer, content):
    record = tmp_path / "auto/seed_0.json"
    record.parent.mkdir()
    record.mkdir() if content is None else record.write_text(content)
    status, errors = run(trainer, HEAT, "--out", tmp_path, "--intervals", 1, "--resume")
    words = "cannot read '{}': it is not a regular file" if content is None else "'{}' is damaged or of another version"
    assert status == 2 and words.format(record) in errors and errors.count("\n") == 1


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_checkpoint_that_is_a_folder_is_one_line(tmp_path, trainer):
    checkpoint = tmp_path / "auto/seed_0.checkpoint"
    checkpoint.mkdir(parents=True)
    for resume in ([], ["--resume"]):
        status, errors = run(trainer, HEAT, "--out", tmp_path, "--intervals", 1, *resume)
        assert status == 2 and f"'{checkpoint}'" in errors and ": it is " in errors and errors.count("\n") == 1


# ---- forgery


class Forged(torch.nn.Module):
    """TorchScript that leaves a trace where it is loaded."""

    def forward(self, u: torch.Tensor):
        return u

    @torch.jit.export
    def __getstate__(self):
        return 0, self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[int, bool]):
        raise RuntimeError("code was run")


class Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.filterwarnings("ignore:`torch.jit", "ignore:'torch.load' received a zip file")
def test_no_checkpoint_runs_code(tmp_path):
    process = subprocess.Popen([TRAINER, HEAT, "--out", tmp_path / "cpp"], stdout=subprocess.PIPE, text=True)
    path = tmp_path / "cpp/auto/seed_0.checkpoint"
    while not path.exists():
        assert process.poll() is None
    process.kill()
    process.communicate()
    script = io.BytesIO()
    torch.jit.save(torch.jit.script(Forged()), script)
    bomb, none = io.BytesIO(), io.BytesIO()
    torch.save(Bomb(str(tmp_path / "crater")), bomb)
    torch.save(None, none)
    contents = (script.getvalue(), bomb.getvalue(), none.getvalue(), b"", b"nothing")
    for content in contents:
        for file in (path, *path.parent.glob("*.before")):
            reseal(file, content)
        status, errors = run("cpp", HEAT, "--out", tmp_path / "cpp", "--resume")
        assert status == 2 and f"'{path}' is damaged or of another version" in errors and "code was run" not in errors

    checkpoint = checkpoint_of(tmp_path / "kept")
    checkpoint.save(*state(1))
    for content in contents:
        reseal(tmp_path / "kept", content)
        with pytest.raises(ValueError, match="is damaged or of another version: expected named tensors; delete it"):
            restored(checkpoint)
    assert not (tmp_path / "crater").exists()


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_finished_training_without_its_weights_is_none(tmp_path, trainer):
    arguments = (trainer, HEAT, "--out", tmp_path, "--constant", 2, "--intervals", 2, "--resume")
    weights = tmp_path / "constant_2/seed_0.pt"
    assert run(*arguments)[0] == 0
    whole, record = weights.read_bytes(), weights.with_suffix(".json").read_bytes()
    weights.write_bytes(whole[:-9])
    status, errors = run(*arguments)
    assert status == 2 and f"weights: '{weights}' is damaged" in errors and "the training is run again" in errors
    assert weights.with_suffix(".json").read_bytes() == record
    weights.unlink()
    assert run(*arguments)[0] == 0 and weights.read_bytes() == whole
