"""Programs that are killed and go on: the same curves, bit for bit, as of those that were left alone."""

import ctypes
import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM

import pytest
import torch
from helpers import reseal
from trainings import frequent_checkpoints, scene_of, without_seconds  # noqa: F401, a fixture of every test here

ROOT = Path(__file__).parents[2]
TRAINERS = {
    "python": [sys.executable, "-m", "prdp_torch", "train"],
    "cpp": [ROOT / "build" / "prdp_train"],
}


def start(trainer, scene, out, *arguments):
    command = [*TRAINERS[trainer], scene, "--prdp", "--out", out, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def run(*arguments):
    """Exit status and errors of a trainer that is left alone."""
    process = start(*arguments)
    _, errors = process.communicate(timeout=300)
    return process.returncode, errors


@pytest.fixture(scope="module")
def left_alone(tmp_path_factory):
    """The curves of a training that nobody kills, by trainer, scene and intervals: each is run once."""
    found = {}

    def curves_of(trainer, scene, intervals):
        key = (trainer, Path(scene).read_text(), intervals)
        if key not in found:
            out = tmp_path_factory.mktemp("alone")
            assert run(trainer, scene, out, "--intervals", intervals)[0] == 0
            found[key] = json.loads((out / "prdp/seed_0.json").read_text())["curves"]
        return found[key]

    return curves_of


def stop(process, checkpoint, signal):
    """Send the signal once a few checkpoints were written; the exit status."""
    seen = set()
    while len(seen) < 4:
        assert process.poll() is None, process.communicate()
        if checkpoint.exists():
            seen.add(checkpoint.stat().st_mtime_ns)
        time.sleep(0.001)
    process.send_signal(signal)
    process.communicate(timeout=300)
    return process.returncode


def seconds_in(trainer, checkpoint):
    """Of the intervals that it holds."""
    state = torch.load(io.BytesIO(checkpoint.read_bytes().split(b"\n", 2)[2]), weights_only=True)  # behind two lines
    return state[state.index("seconds") + 1].tolist()  # names and tensors by turns


@pytest.mark.parametrize(  # test_kills.py has more of both trainers
    "trainer, task, intervals, signals",
    [
        ("python", "emulator", 150, [SIGKILL, SIGTERM, SIGINT]),
        ("cpp", "emulator", 150, [SIGKILL, SIGTERM, SIGINT]),
        ("cpp", "parameters", 300, [SIGKILL]),
        ("python", "corrector", 40, [SIGKILL]),
        ("cpp", "corrector", 40, [SIGKILL]),
        ("cpp", "field", 150, [SIGKILL]),
    ],
)
def test_a_killed_training_goes_on_bit_for_bit(tmp_path, left_alone, trainer, task, intervals, signals):
    scene = scene_of(task, tmp_path)
    alone = left_alone(trainer, scene, intervals)
    assert len(set(alone["max_iter"])) > 1  # the controller has something to remember

    record, checkpoint = (tmp_path / "killed/prdp" / f"seed_0.{kind}" for kind in ("json", "checkpoint"))
    arguments = (trainer, scene, tmp_path / "killed", "--intervals", intervals, "--resume")
    kept = []
    for signal in signals:
        is_handled = signal == SIGINT or (signal == SIGTERM and trainer == "cpp")
        assert stop(start(*arguments), checkpoint, signal) == (128 + signal if is_handled else -signal)
        assert not record.exists()
        before, kept = kept, seconds_in(trainer, checkpoint)
        assert kept[: len(before)] == before and len(before) < len(kept) < intervals
    assert run(*arguments)[0] == 0
    curves = json.loads(record.read_text())["curves"]
    assert without_seconds(curves) == without_seconds(alone)
    assert curves["seconds"][: len(kept)] == kept and len(curves["seconds"]) == intervals
    assert record.exists() and not checkpoint.exists() and not list(record.parent.glob("*.part"))


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_damaged_checkpoint_is_one_line_and_harms_nothing(tmp_path, trainer):
    checkpoint = tmp_path / "here/prdp/seed_0.checkpoint"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.write_text("nothing of the kind\n")
    arguments = (trainer, scene_of("emulator", tmp_path), tmp_path / "here", "--intervals", 2)
    status, errors = run(*arguments, "--resume")
    assert status == 2 and checkpoint.read_text() == "nothing of the kind\n"
    assert errors.endswith(
        f"checkpoint: '{checkpoint}' is damaged or of another version: its content is not that of its fingerprint; "
        "delete it, and its training starts afresh\n"
    )
    assert errors.count("\n") == 1
    status, errors = run(*arguments)
    assert status == 0 and (checkpoint.parent / "seed_0.json").exists() and not checkpoint.exists(), errors


def test_a_checkpoint_of_other_settings_is_not_gone_on_from_in_cpp(tmp_path):
    scene, out = scene_of("emulator", tmp_path), tmp_path / "killed"
    stop(start("cpp", scene, out, "--intervals", 1000), out / "prdp/seed_0.checkpoint", SIGKILL)
    status, errors = run("cpp", scene, out, "--intervals", 1, "--resume")
    assert status == 2 and "intervals, more than the 1 asked for" in errors
    left = {path: path.read_bytes() for path in (out / "prdp").iterdir()}
    for more in ([], ["--resume"]):
        status, errors = run("cpp", scene, out, "--intervals", 3, "--backward", "unrolled", *more)
        assert status == 2 and "is of a training that has not ended, with other settings or of another" in errors
        assert {path: path.read_bytes() for path in (out / "prdp").iterdir()} == left


@pytest.mark.parametrize("trainer", TRAINERS)
def test_where_the_last_checkpoint_is_damaged_the_one_before_is_gone_on_from(tmp_path, left_alone, trainer):
    scene = scene_of("parameters", tmp_path)
    arguments = ("--intervals", 300)
    alone = left_alone(trainer, scene, 300)
    record, checkpoint = (tmp_path / "killed/prdp" / f"seed_0.{kind}" for kind in ("json", "checkpoint"))
    stop(start(trainer, scene, tmp_path / "killed", *arguments), checkpoint, SIGKILL)
    damaged = checkpoint.read_bytes()[:-20]
    checkpoint.unlink()  # the kill may have left both names with one file
    checkpoint.write_bytes(damaged)
    status, errors = run(trainer, scene, tmp_path / "killed", *arguments, "--resume")
    assert status == 0
    assert f"checkpoint: '{checkpoint}' is damaged or of another version: its content is not that" in errors
    assert errors.count("; the training goes on from the one before\n") == 1
    curves = json.loads(record.read_text())["curves"]
    assert without_seconds(curves) == without_seconds(alone)
    assert sorted(path.name for path in record.parent.iterdir()) == ["seed_0.json", "seed_0.pt"]


def without_a_part(trainer, content):
    """A state that lacks what is loaded last."""
    state = torch.load(io.BytesIO(content), weights_only=True)
    last = state.index("history_residual")
    state = (*state[:last], *state[last + 2 :])
    changed = io.BytesIO()
    torch.save(state, changed)
    return changed.getvalue()


@pytest.mark.parametrize(
    "trainer, change", [("cpp", lambda *_: b"no state at all"), ("cpp", without_a_part), ("python", without_a_part)]
)
def test_where_the_last_checkpoint_was_tampered_with_the_one_before_is_gone_on_from(
    tmp_path, left_alone, trainer, change
):
    scene = scene_of("parameters", tmp_path)
    arguments = ("--intervals", 300)
    alone = left_alone(trainer, scene, 300)
    record, checkpoint = (tmp_path / "killed/prdp" / f"seed_0.{kind}" for kind in ("json", "checkpoint"))
    stop(start(trainer, scene, tmp_path / "killed", *arguments), checkpoint, SIGKILL)
    content = checkpoint.read_bytes().split(b"\n", 2)[2]
    reseal(checkpoint, change(trainer, content))
    status, errors = run(trainer, scene, tmp_path / "killed", *arguments, "--resume")
    assert status == 0, errors
    words = {b"no state at all": "expected named tensors"}.get(change(trainer, content), "there is no tensor 'history_")
    assert f"checkpoint: '{checkpoint}' is damaged or of another version: {words}" in errors
    assert errors.count("; the training goes on from the one before\n") == 1
    curves = json.loads(record.read_text())["curves"]
    assert without_seconds(curves) == without_seconds(alone)


@pytest.mark.parametrize("trainer", TRAINERS)
def test_where_both_checkpoints_were_tampered_with_it_is_one_line(tmp_path, trainer):
    scene, out = scene_of("parameters", tmp_path), tmp_path / "killed"
    checkpoint = out / "prdp/seed_0.checkpoint"
    stop(start(trainer, scene, out, "--intervals", 300), checkpoint, SIGKILL)
    reseal(checkpoint, b"no state at all")
    reseal(checkpoint.with_suffix(".checkpoint.before"), b"no state either")
    status, errors = run(trainer, scene, out, "--intervals", 300, "--resume")
    assert status == 2
    assert errors.endswith(
        f"checkpoint: '{checkpoint}' is damaged or of another version: expected named tensors; delete it, and its "
        "training starts afresh\n"
    )
    assert errors.count("\n") == 1
    assert not (out / "prdp/seed_0.json").exists()


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_killed_training_is_not_begun_anew_unasked(tmp_path, trainer):
    scene, out = scene_of("parameters", tmp_path), tmp_path / "killed"
    checkpoint = out / "prdp/seed_0.checkpoint"
    stop(start(trainer, scene, out, "--intervals", 300), checkpoint, SIGKILL)
    left = checkpoint.read_bytes()
    status, errors = run(trainer, scene, out, "--intervals", 300, "--seeds", 2)
    assert status == 2 and errors.count("\n") == 1
    assert f"checkpoint: '{checkpoint}' is of a training that has not ended: pass --resume to go on with it" in errors
    assert checkpoint.read_bytes() == left


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_checkpoint_that_a_kill_has_left_beside_its_record_goes(tmp_path, trainer):
    scene, out = scene_of("parameters", tmp_path), tmp_path / "out"
    arguments = (trainer, scene, out, "--intervals", 3)
    assert run(*arguments)[0] == 0
    record = out / "prdp/seed_0.json"
    left = [out / "prdp" / f"seed_0.checkpoint{end}" for end in ("", ".before")]
    for path in left:
        path.write_text("of any kind")
    later = record.stat().st_mtime + 1
    os.utime(left[0], (later, later))  # of a training that was begun afterwards
    assert run(*arguments, "--resume")[0] == 0
    assert all(path.exists() for path in left)
    earlier = later - 2
    os.utime(left[0], (earlier, earlier))
    assert run(*arguments, "--resume")[0] == 0
    assert sorted(path.name for path in record.parent.iterdir()) == [record.name, "seed_0.pt"]


def with_the_rights_of_a_user():
    """Even root obeys the rights of a folder then."""
    if os.geteuid() == 0:
        drop, override = 24, (1, 2)  # PR_CAPBSET_DROP; CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        for capability in override:
            assert ctypes.CDLL(None).prctl(drop, capability, 0, 0, 0) == 0


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_folder_that_cannot_be_written_to_is_one_line(tmp_path, trainer):
    scene, out = scene_of("parameters", tmp_path), tmp_path / "out"
    (out / "prdp").mkdir(parents=True)
    for folder in (out / "prdp", out):
        folder.chmod(0o555)
        command = [*TRAINERS[trainer], scene, "--out", out, "--intervals", "2", "--prdp"]
        done = subprocess.run(command, capture_output=True, text=True, preexec_fn=with_the_rights_of_a_user)
        assert done.returncode == 2 and "Permission denied" in done.stderr and done.stderr.count("\n") == 1
        assert f"cannot write to '{out}" in done.stderr or f"cannot write '{out}" in done.stderr
        folder.chmod(0o755)
        assert list((out / "prdp").iterdir()) == []
        folder.chmod(0o555)
