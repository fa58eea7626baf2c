"""Files that two processes write at once, or that find a full disk; commands that cannot do what they are asked."""

import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers import written
from trainings import frequent_checkpoints  # noqa: F401, a fixture of every test here
from typer.testing import CliRunner

from prdp_torch.experiments import _C, cli, records, scenes
from prdp_torch.experiments.checkpoint import Checkpoint
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

ROOT = Path(__file__).parents[2]
PRDP = [sys.executable, "-m", "prdp_torch"]
TRAINER = ROOT / "build" / "prdp_train"
TRAINERS = {"python": [*PRDP, "train"], "cpp": [TRAINER]}
HEAT = scenes.available()["heat_1d"]


def in_process_of_its_own(trainer, *arguments, **options):
    """Exit status and errors of a trainer."""
    command = [*TRAINERS[trainer], *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, **options)
    return done.returncode, done.stderr


def run(trainer, *arguments):
    """The same; the Python trainer in this process, which has imported torch already."""
    if trainer == "cpp":
        return in_process_of_its_own(trainer, *arguments)
    done = CliRunner().invoke(cli.app, ["train", *map(str, arguments)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.stderr


def short(intervals=2):
    scene = scenes.load("heat_1d")
    scene.training.intervals = intervals
    return scene


# ---- going on


class Dropout(torch.nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.layer = torch.nn.Linear(30, 30)

    def forward(self, u):
        return torch.nn.functional.dropout(self.layer(u), 0.3)


def test_a_network_with_dropout_goes_on_bit_for_bit(tmp_path):
    scene = short(6)
    alone = train(scene, Refinement.prdp(scene), network=Dropout())
    checkpoint = Checkpoint(tmp_path / "kept")

    def stop(interval):
        if interval.number == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(scene, Refinement.prdp(scene), network=Dropout(), checkpoint=checkpoint, callbacks=[stop])
    torch.rand(17)
    rest = train(scene, Refinement.prdp(scene), network=Dropout(), checkpoint=checkpoint)
    assert rest["update_loss"] == alone["update_loss"] and rest["metric"] == alone["metric"]


def test_a_network_with_dropout_follows_the_seed_and_leaves_the_generator_alone():
    """Whatever was drawn before; the initial weights are set beside, so that only the dropout differs."""
    losses = []
    for seed in (0, 0, 1):
        network = Dropout()
        torch.rand(len(losses))
        before = torch.get_rng_state()
        losses.append(train(short(2), Refinement.constant(3), seed=seed, network=network)["update_loss"])
        assert torch.equal(torch.get_rng_state(), before)
    assert losses[0] == losses[1] != losses[2]


def test_a_checkpoint_of_another_network_is_refused(tmp_path):
    scene, checkpoint = short(3), Checkpoint(tmp_path / "kept")
    train(scene, Refinement.prdp(scene), network=Dropout(), checkpoint=checkpoint)
    with pytest.raises(ValueError, match="is damaged or of another version"):
        train(scene, Refinement.prdp(scene), checkpoint=checkpoint)


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_finished_training_is_not_overwritten_by_a_longer_one(tmp_path, trainer):
    arguments = (trainer, HEAT, "--out", tmp_path, "--constant", 2)
    assert run(*arguments, "--intervals", 2)[0] == 0
    record = (tmp_path / "constant_2/seed_0.json").read_bytes()
    status, errors = run(*arguments, "--intervals", 3, "--resume")
    assert status == 2 and "is of a finished training of 2 intervals, not 3; it cannot go on" in errors
    assert (tmp_path / "constant_2/seed_0.json").read_bytes() == record


# ---- two processes, and a full disk


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_folder_is_trained_into_by_one_process_at_a_time(tmp_path, trainer):
    folder = tmp_path / "auto"
    folder.mkdir()
    (folder / "seed_0.json.1-0.part").touch()  # of a killed process
    lock = _C.FolderLock(folder)
    assert list(folder.iterdir()) == []
    status, errors = run(trainer, HEAT, "--out", tmp_path, "--intervals", 1)
    assert status == 2 and f"--out: another process is training into '{folder}'; wait until it ends" in errors
    lock.release()
    assert run(trainer, HEAT, "--out", tmp_path, "--intervals", 1)[0] == 0


def test_many_processes_with_one_folder_finish_or_say_why(tmp_path):
    command = [TRAINER, HEAT, "--out", tmp_path, "--intervals", "5"]
    processes = [
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) for _ in range(8)
    ]
    ends = [(process.communicate(timeout=300)[1], process.returncode) for process in processes]
    assert any(status == 0 for _, status in ends)
    for errors, status in ends:
        assert status == 0 or (status == 2 and "another process is training into" in errors and errors.count("\n") == 1)
    assert records.read(tmp_path / "auto/seed_0.json")["curves"]["metric"]
    assert sorted(path.name for path in (tmp_path / "auto").iterdir()) == ["seed_0.json", "seed_0.pt"]


@pytest.mark.parametrize("trainer, most", [("python", 8000), ("cpp", 1000)])  # weights, a record
def test_a_full_disk_is_one_line_and_leaves_the_old_record(tmp_path, trainer, most):
    def no_room():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    arguments = (trainer, HEAT, "--out", tmp_path, "--intervals")
    assert run(*arguments, 1)[0] == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "auto").iterdir()}
    calm = {**os.environ, "PRDP_CHECKPOINT_SECONDS": "1000"}
    status, errors = in_process_of_its_own(*arguments, 2, preexec_fn=no_room, env=calm)
    *told, error = errors.splitlines()
    assert status == 2 and "cannot write '" in error and "File too large" in error
    assert len(told) == 1 and ": replaces when it ends: '" in told[0]
    assert {path.name: path.read_bytes() for path in (tmp_path / "auto").iterdir()} == before


# ---- errors in one line


def both(*arguments):
    """Exit status and errors of both trainers."""
    return [run(trainer, *arguments) for trainer in TRAINERS]


@pytest.mark.parametrize(
    "changes, words",
    [
        ([("train = 200", "train = 10000000000000")], "out of memory: cannot allocate 800000000"),
        ([('title = "', 'title = "\x00')], "changed.toml:4: Error while parsing string"),
    ],
)
def test_a_scene_that_asks_for_too_much_is_one_line_in_both_languages(tmp_path, changes, words):
    path = written(tmp_path, *changes)
    for status, errors in both(path, "--out", tmp_path / "out"):
        assert status == 2 and words in errors and errors.count("\n") == 1


def test_a_reference_that_does_not_converge_is_one_line_in_both_languages(tmp_path):
    path = written(tmp_path, ("dt = 0.2", "dt = 2e9"), ("nu = 1e-2", "nu = 0"), scene="burgers_2d")
    path = Path(path)
    path.write_text(path.read_text().replace("shape = [96, 96]", "shape = [12, 12]"))
    for status, errors in both(path, "--out", tmp_path / "out"):
        assert status == 2 and "the scene's dt is too long for it" in errors and errors.count("\n") == 1


@pytest.mark.parametrize("option", ["--constant", "--intervals", "--seeds"])
def test_numbers_beyond_all_bounds_exit_2_in_both_languages(tmp_path, option):
    for status, errors in both(HEAT, "--out", tmp_path / "out", option, 99999999999999999999):
        assert status == 2 and option in errors and "1000000000" in errors and not (tmp_path / "out").exists()


def test_brackets_in_a_path_are_no_markup(tmp_path):
    for status, errors in both(HEAT, "--out", tmp_path / "x[/red]y", "--intervals", 1):
        assert status == 0, errors


@pytest.mark.parametrize("kind", ["pipe", "folder", "nested"])
def test_what_is_no_scene_is_refused(tmp_path, kind):
    path = tmp_path / "scene.toml"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.write_text(".".join(["a"] * 300_000) + " = 1\n")
    words = "has 600004 bytes; a scene has at most 65536" if kind == "nested" else "it is not a regular file"
    with pytest.raises(ValueError, match=words):
        _C.read_scene(str(path))


def test_emulators_whose_data_take_long_are_cached(tmp_path):
    path = Path(written(tmp_path, ("train = ", "train = 4 # "), scene="burgers_2d"))
    path.write_text(path.read_text().replace("shape = [96, 96]", "shape = [8, 8]"))
    scene = scenes.load(path)
    once = _C.make_dataset(scene)
    (file,) = (tmp_path / "cache").iterdir()
    assert file.name.startswith("burgers-")

    def no_solve(done, total):
        raise AssertionError("the data were made again")

    again = _C.make_dataset(scene, no_solve)
    assert torch.equal(once.train_end, again.train_end) and again.train_between is None
    _C.make_dataset(scenes.load("heat_1d"))
    assert len(list((tmp_path / "cache").iterdir())) == 1
    other = Path(shutil.copy(path, tmp_path / "modes.toml"))
    other.write_text(other.read_text().replace("modes = ", "modes = 2 # "))
    _C.make_dataset(scenes.load(other))
    assert len(list((tmp_path / "cache").iterdir())) == 2
