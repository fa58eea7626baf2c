"""`make records-gpu`: its parts, and how a call ends and goes on."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from benchmarks import records_gpu, refinement
from benchmarks.records import ROOT
from prdp_torch.experiments import scenes


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["records_gpu", *arguments])
    records_gpu.main()


def test_each_part_is_a_row_of_its_scene():
    for part in records_gpu.PARTS:
        scene = scenes.load(part.scene)
        assert part.row in [row.label for row in refinement.rows_of(scene)] and scene.trains_network | (
            scene.task == "field"
        )
    assert len({part.name for part in records_gpu.PARTS}) == len(records_gpu.PARTS) == 7 * 6 + 6


def test_the_parts_can_be_listed_without_a_gpu(monkeypatch, capsys):
    call(monkeypatch, "--list", "kolmogorov_unet", "burgers_2d/auto")
    shown = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in shown] == ["burgers_2d/auto", *(
        f"kolmogorov_unet/{row}" for row in (*records_gpu.ROWS, "direct")
    )]  # fmt: skip
    assert all("-m benchmarks.refinement" in line and "--device cuda" in line and "--resume" in line for line in shown)


def test_it_refuses_in_one_sentence_where_there_is_no_gpu():
    command = [sys.executable, "-m", "benchmarks.records_gpu"]
    hidden = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(command, cwd=ROOT, env=hidden, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("records-gpu: device: there is no 'cuda', as torch finds no GPU")


def test_unknown_parts_and_changes_that_are_not_committed_are_refused(monkeypatch, capsys):
    monkeypatch.setattr(records_gpu.records, "environment", lambda: {"commit": "abc-dirty"})
    for arguments, words in ((["moon"], "unknown: moon"), (["--device", "cpu"], "not committed")):
        with pytest.raises(SystemExit):
            call(monkeypatch, *arguments)
        assert words in capsys.readouterr().err


@pytest.fixture
def folders(tmp_path, monkeypatch):
    monkeypatch.setattr(records_gpu, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(records_gpu, "ROOT", tmp_path)
    (tmp_path / "docs" / "results").mkdir(parents=True)
    return tmp_path


def make(parts, minutes=5.0):
    return records_gpu.make(parts, "abc", "cpu", time.monotonic() + 60 * minutes)


def test_what_is_there_is_kept_and_the_record_has_all_rows(folders, monkeypatch):
    monkeypatch.setattr(records_gpu, "SEEDS", 2)
    monkeypatch.setenv("PYTHONPATH", str(Path(records_gpu.__file__).parents[1]))
    parts = [records_gpu.Part("poisson_1p", row) for row in ("rtol_0.1", "auto")]
    assert make(parts[:1]) == 0
    before = (folders / "runs/abc/poisson_1p/rtol_0.1/seed_1.json").stat().st_mtime_ns
    assert make(parts) == 0
    assert (folders / "runs/abc/poisson_1p/rtol_0.1/seed_1.json").stat().st_mtime_ns == before
    record = json.loads((folders / "docs/results/gpu/poisson_1p.json").read_text())
    assert {row["label"]: row["seeds"] for row in record["rows"]} == {"rtol_0.1": 2, "auto": 2}
    assert record["versions"]["torch"] == torch.__version__ and record["commit"]


def test_a_call_ends_in_time_and_says_that_there_is_more(folders, monkeypatch, capsys):
    slow = "import time, signal; time.sleep(60)"
    monkeypatch.setattr(records_gpu.Part, "command", lambda *_: ["-c", slow])
    began = time.monotonic()
    assert make([records_gpu.Part("poisson_1p", "auto")], minutes=0.5 / 60) == records_gpu.MORE_TO_DO
    assert time.monotonic() - began < 20 and "the same command goes on" in capsys.readouterr().err
    assert not (folders / "docs/results/gpu").exists()


def test_a_training_that_fails_ends_the_call(folders, monkeypatch):
    monkeypatch.setattr(records_gpu.Part, "command", lambda *_: ["-c", "raise SystemExit(7)"])
    assert make([records_gpu.Part("poisson_1p", "auto")]) == 7
