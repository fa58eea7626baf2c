"""What the command `prdp` does not pass over in silence: trainings that are lost, and records that it replaces."""

import json
import subprocess
from pathlib import Path

import pytest
from helpers import written
from typer.testing import CliRunner

from prdp_torch.experiments import cli, compare, records, scenes
from prdp_torch.experiments.checkpoint import difference
from prdp_torch.experiments.refinement import Refinement

TRAINER = Path(__file__).parents[2] / "build" / "prdp_train"


def prdp(*arguments):
    """Exit status, and what was said on stderr."""
    done = CliRunner().invoke(cli.app, list(map(str, arguments)))
    return done.exit_code, done.stderr


@pytest.mark.parametrize(
    "rate, why",
    [
        ("1e17", "its relative error is "),  # finite in float64
        ("1e300", "interval 1: the metric is "),
        ("1e-3", None),
    ],
)
def test_a_training_that_ends_nowhere_is_exit_1_with_its_record(tmp_path, rate, why):
    changes = ("float32", "float64"), ("learning_rate = 1e-3", f"learning_rate = {rate}"), ("train = 200", "train = 20")
    scene = written(tmp_path, *changes)
    status, said = prdp("train", scene, "--intervals", 2, "--out", tmp_path / "python")
    command = [TRAINER, scene, "--intervals", "2", "--out", tmp_path / "cpp"]
    cpp = subprocess.run(command, capture_output=True, text=True)
    assert status == cpp.returncode == (0 if why is None else 1)
    assert why is None or (f"prdp: seed 0 diverged, {why}" in said and f"_train: seed 0 diverged, {why}" in cpp.stderr)
    for language in ("python", "cpp"):
        curves = json.loads((tmp_path / language / "auto/seed_0.json").read_text())["curves"]
        assert why is None or curves["metric"][-1] is None or curves["metric"][-1] > 1e20


def unfinished(scene, folder, intervals=4):
    """The checkpoint of a training that has stopped after its first interval, and what is in it."""
    loaded = scenes.load(scene)
    loaded.training.intervals = intervals
    refinement, environment = Refinement.auto(), records.environment()
    with pytest.raises(KeyboardInterrupt):
        compare.run_one(loaded, refinement.label, refinement, 0, folder, environment, False, [interrupt])
    path = folder / "auto/seed_0.checkpoint"
    return path, path.read_bytes()


def interrupt(interval):
    raise KeyboardInterrupt


SHORT = ("train = 200", "train = 20"), ("epochs = 100", "epochs = 4")


@pytest.mark.parametrize("options", [[], ["--resume"]])
@pytest.mark.parametrize(
    "changes, more, differs",
    [
        ([], ["--backward", "unrolled"], "backward was 'implicit', and is 'unrolled'"),
        ([("nu = 1e-3", "nu = 2e-3")], [], "the scene file was 'nu = 1e-3', and is 'nu = 2e-3'"),
    ],
)
def test_an_unfinished_training_of_other_settings_is_refused_in_words(
    tmp_path, monkeypatch, options, changes, more, differs
):
    monkeypatch.setenv("PRDP_CHECKPOINT_SECONDS", "0")
    path, left = unfinished(written(tmp_path, *SHORT), tmp_path)
    status, said = prdp("train", written(tmp_path, *SHORT, *changes), *more, *options, "--out", tmp_path)
    assert status == 2 and path.read_bytes() == left
    path.with_suffix(".json").touch()  # as that of an earlier training which was copied
    assert prdp("train", written(tmp_path, *SHORT, *changes), *more, *options, "--out", tmp_path)[0] == 2
    assert path.read_bytes() == left
    path.with_suffix(".json").unlink()
    assert f"checkpoint: '{path}' is of a training that has not ended, with other settings: {differs}; " in said
    status, said = prdp("train", written(tmp_path, *SHORT), "--resume", "--out", tmp_path)
    assert (status, said) == (0, "") and not path.exists()


def test_finished_records_that_are_replaced_are_told_before(tmp_path):
    scene = written(tmp_path, *SHORT)
    train = "train", scene, "--intervals", 1, "--out", tmp_path
    record = tmp_path / "auto/seed_0.json"
    assert prdp(*train) == (0, "")
    assert prdp(*train, "--resume") == (0, "")
    assert prdp(*train) == (0, f"prdp: replaces when it ends: '{record}', of the same settings\n")
    words = f"prdp: replaces when it ends: '{record}' (backward was 'implicit', and is 'unrolled')\n"
    assert prdp(*train, "--backward", "unrolled", "--resume", "--seeds", 2) == (0, words)
    record.write_text("damaged")
    assert prdp(*train) == (0, f"prdp: replaces when it ends: '{record}', which is damaged\n")


def test_prdp_train_tells_of_them_too(tmp_path):
    scene = written(tmp_path, *SHORT)
    record = tmp_path / "auto/seed_0.json"

    def said(*more):
        done = subprocess.run(
            [TRAINER, scene, "--intervals", "1", "--out", tmp_path, *more], capture_output=True, text=True, check=True
        )
        return done.stderr

    told = "prdp_train: replaces when it ends: "
    assert said() == said("--resume") == ""
    assert said() == f"{told}'{record}', of the same settings\n"
    other = "--resume", "--backward", "unrolled"
    assert said(*other, "--seeds", "2") == f"{told}'{record}', of other settings\n"
    assert said("--seeds", "2") == f"{told}'{record}', of other settings, and 1 more\n"
    record.write_text("damaged")
    assert said() == f"{told}'{record}', which is damaged\n"


def test_of_files_that_differ_it_is_said_which():
    there, here = (
        {"data": "1f", "network": "2a", "backward": "none"},
        {"data": "1f", "network": "2b", "backward": "none"},
    )
    assert difference(there, here) == "the module of the network has changed"
    assert difference(there, {**there, "data": "1e"}) == "the file of the data has changed"
