"""`make records`: its list, and what it does without a training."""

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from benchmarks import check_records, records
from docs import record_tables
from prdp_torch.experiments import compare
from prdp_torch.experiments import records as of_trainings

DOCS = Path(records.__file__).parents[1] / "docs"


def test_every_record_of_the_documentation_is_in_the_list():
    kept = {entry.kept for entry in records.LIST}
    assert len({entry.name for entry in records.LIST}) == len(records.LIST)
    found = {str(path.relative_to(DOCS)) for path in DOCS.rglob("*.json")}
    atlas = {path for path in found if path.startswith("stability/")}
    assert found - atlas - set(record_tables.OTHERS) <= kept


def test_what_is_done_on_this_commit_is_not_done_again(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "ROOT", tmp_path)
    monkeypatch.setattr(records, "RUNS", tmp_path / "runs")
    (tmp_path / "docs" / "results").mkdir(parents=True)
    calls = []

    def run(command, **options):
        calls.append(command)
        folder = tmp_path / command[-1]
        folder.mkdir(parents=True)
        (folder / "summary.json").write_text("{}")

    monkeypatch.setattr(records.subprocess, "run", run)
    entry = records.refinement("heat_1d", 10, 3)
    for commit in ("a", "a", "b"):
        records.make(entry, commit)
    assert len(calls) == 2 and "--resume" in calls[0]
    assert not list((tmp_path / "docs" / "results").iterdir())  # a change there would mark the next record as dirty
    records.keep(entry, "b")
    assert (tmp_path / "docs" / "results" / "refinement_heat_1d.json").read_text() == "{}"


def test_the_study_of_inference_takes_the_networks_of_the_same_commit(tmp_path, monkeypatch):
    calls = {}

    def run(command, **options):
        (tmp_path / command[-1]).mkdir(parents=True)
        calls[command[-1].name] = command

    monkeypatch.setattr(records, "ROOT", tmp_path)
    monkeypatch.setattr(records, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(records.subprocess, "run", run)
    for entry in records.LIST:
        if entry.name in ("refinement_navier_stokes", "inference"):
            records.make(entry, "a")
    trained, study = calls["refinement_navier_stokes"], calls["inference"]
    assert study[study.index("--trainings") + 1] == str(trained[-1])


@pytest.mark.parametrize("arguments, words", [(["moon"], "unknown record 'moon'"), (["heat_1d"], "not committed")])
def test_it_refuses_what_it_does_not_know_and_changes_that_are_not_committed(arguments, words, monkeypatch, capsys):
    monkeypatch.setattr(records.records, "environment", lambda: {"commit": "abc-dirty"})
    monkeypatch.setattr(sys, "argv", ["records", *arguments])
    with pytest.raises(SystemExit):
        records.main()
    assert words in capsys.readouterr().err


def test_a_check_trains_the_first_seed_and_sees_any_other_number():
    scene = check_records.scenes.load("heat_1d")
    row = next(row for row in check_records.refinement.rows_of(scene) if row.label == "auto")
    environment = of_trainings.environment()
    with tempfile.TemporaryDirectory() as folder:
        row.curves.append(compare.run_one(scene, row.label, row.refinement, 0, Path(folder), environment))
    (kept,) = compare.summarise(scene, [row])
    assert check_records.is_same("heat_1d", kept, environment)
    kept["each"]["metric"][0] *= 1 + 1e-15
    assert not check_records.is_same("heat_1d", kept, environment)


def test_a_check_passes_over_other_processors_long_rows_and_means():
    here, there = {"processor": "here"}, {"processor": "there"}
    rows = [{"each": {}, "seconds": 1.0, "label": "a"}, {"each": {}, "seconds": 200.0}, {"seconds": 1.0},
            {"each": {}, "seconds": 1.0, "machine": there}]  # fmt: skip
    found = check_records.checkable({"machine": here, "rows": rows}, here, limit=100.0)
    assert [row["label"] for row in found] == ["a"]


def test_the_list_can_be_printed():
    done = subprocess.run([sys.executable, "-m", "benchmarks.records", "--list"], cwd=DOCS.parent, capture_output=True,
                          text=True)  # fmt: skip
    assert done.returncode == 0 and len(done.stdout.splitlines()) == len(records.LIST)


def test_a_record_names_the_family_of_the_processor(monkeypatch):
    text = "processor\t: 0\ncpu family\t: 25\nmodel\t\t: 17\nmodel name\t: AMD EPYC\n\nprocessor\t: 1\nmodel\t\t: 18\n"
    monkeypatch.setattr(Path, "exists", lambda self: True)
    monkeypatch.setattr(Path, "read_text", lambda self: text)
    assert of_trainings._processor() == "AMD EPYC, family 25, model 17"
