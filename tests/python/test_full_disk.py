"""Disks that fill at every byte of a file, real and by a limit: what was there stays, whole, and one line says why."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers import written
from small_disk import PAGE, SmallDisk, file_size_limit, limit_of_a_child
from trainings import checkpoint_of, frequent_checkpoints, state  # noqa: F401, a fixture of every test here

from prdp_torch.experiments import _C, datasets, pdebench, records, scenes

TRAINERS = {
    "python": [sys.executable, "-m", "prdp_torch", "train"],
    "cpp": [Path(__file__).parents[2] / "build" / "prdp_train"],
}
NO_ROOM = "No space left on device|File too large"


def states_in(checkpoint):
    """Of both files, the last one first; every one that is there is whole."""
    kept = []
    for path, content, wrong in checkpoint.find():
        assert wrong == "", (path, wrong)
        kept.append(float(_C.Saved(content).take("theta", torch.zeros(())).item()))
    return kept


def saved_or_refused(save):
    try:
        save()
    except ValueError as error:
        assert "cannot write '" in str(error) and any(words in str(error) for words in NO_ROOM.split("|")), error
        assert "\n" not in str(error)
        return False
    return True


def test_a_disk_that_fills_at_any_byte_of_a_checkpoint_takes_neither_of_the_two(tmp_path):
    checkpoint = checkpoint_of(tmp_path / "kept")
    for number in (1, 2):
        checkpoint.save(*state(number))
    size = (tmp_path / "kept").stat().st_size
    for most in range(size):
        with file_size_limit(most):
            assert not saved_or_refused(lambda: checkpoint.save(*state(3)))
        assert states_in(checkpoint) == [2.0, 1.0], most
    with file_size_limit(size):
        checkpoint.save(*state(3))
    assert states_in(checkpoint) == [3.0, 2.0] and len(list(tmp_path.iterdir())) == 2


def test_a_real_disk_that_fills_at_any_page_of_a_checkpoint_takes_neither_of_the_two(tmp_path):
    with SmallDisk(tmp_path / "disk", 64 * PAGE) as disk:
        checkpoint = checkpoint_of(disk.folder / "kept")
        large = torch.zeros(8 * PAGE // 4)
        for number in (1, 2):
            checkpoint.save(*state(number, large))
        outcomes = []
        for pages in range(16):
            with disk.leaving(pages):
                outcomes.append(saved_or_refused(lambda: checkpoint.save(*state(3, large))))
            if outcomes[-1]:
                break
            assert states_in(checkpoint) == [2.0, 1.0], pages
        assert outcomes[-1] and len(outcomes) > 8
        assert states_in(checkpoint) == [3.0, 2.0]
        assert sorted(path.name for path in disk.folder.iterdir()) == ["kept", "kept.before"]


def test_a_disk_that_fills_at_any_byte_of_a_record_or_its_weights_leaves_the_old_pair(tmp_path):
    path = tmp_path / "seed_0.json"
    old, new = b"old weights" * 20, b"new weights" * 30

    def write(weights, text):
        _C.write_training(path, f'{{"weights": "{_C.fingerprint(weights)}", "text": "{text}"}}', weights)

    write(old, "old")
    before = path.read_text()
    largest = max(len(new), len(before) + 100)
    for most in range(len(new)):
        with file_size_limit(most):
            assert not saved_or_refused(lambda: write(new, "new" * 100))
        assert path.read_text() == before and _C.read_weights(path, _C.fingerprint(old)) == old
    with file_size_limit(len(new)):  # the weights fit, their record does not
        assert not saved_or_refused(lambda: write(new, "new" * 100))
    assert path.read_text() == before and _C.read_weights(path, _C.fingerprint(old)) == old
    assert sorted(p.name for p in tmp_path.iterdir()) == ["seed_0.json", "seed_0.pt"]
    with file_size_limit(10 * largest):
        write(new, "new")
    assert _C.read_weights(path, _C.fingerprint(new)) == new and len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("name", ["x.h5", "x.npz"])
def test_an_export_onto_a_full_disk_leaves_the_old_file(tmp_path, name):
    scene = scenes.load(written(tmp_path, ("train = 200", "train = 20")))
    with SmallDisk(tmp_path / "disk", 64 * PAGE) as disk:
        path = disk.folder / name
        datasets.export(scene, path)
        old, whole = path.read_bytes(), pdebench.read(path, scene)
        for pages in range(0, len(old) // PAGE):
            with disk.leaving(pages):
                assert not saved_or_refused(lambda: datasets.export(scene, path))
            assert path.read_bytes() == old
        assert torch.equal(pdebench.read(path, scene), whole) and [p.name for p in disk.folder.iterdir()] == [name]


@pytest.mark.parametrize("trainer", TRAINERS)
def test_a_training_on_a_disk_that_fills_is_one_line_and_goes_on_bit_for_bit(tmp_path, trainer):
    scene = written(tmp_path)

    def run(out, *more, **options):
        command = [*TRAINERS[trainer], scene, "--out", out, "--intervals", "30", "--prdp", *more]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, **options)
        return done.returncode, done.stderr

    assert run(tmp_path / "alone")[0] == 0
    with SmallDisk(tmp_path / "disk", 256 * PAGE) as disk:
        out = disk.folder / "out"
        # Room for one checkpoint of some 110 kB, not for the next.
        limit = {} if disk.mounted else {"preexec_fn": limit_of_a_child(100_000)}
        with disk.leaving(45) if disk.mounted else file_size_limit(-1):
            status, errors = run(out, **limit)
        assert status == 2 and "cannot write '" in errors and errors.count("\n") == 1, errors
        assert not disk.mounted or (out / "prdp/seed_0.checkpoint").exists()
        assert not list(out.glob("prdp/*.part"))
        assert run(out, "--resume")[0] == 0
        curves = [records.read_training(folder / "prdp/seed_0.json")["curves"] for folder in (out, tmp_path / "alone")]
        for one in curves:
            one.pop("seconds")
        assert curves[0] == curves[1] and sorted(os.listdir(out / "prdp")) == ["seed_0.json", "seed_0.pt"]
