"""The rows of `python -m benchmarks.refinement`."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import refinement
from prdp_torch.experiments import compare, scenes

OF_BENCHMARKS = sorted(map(str, (Path(refinement.__file__).parent / "scenes").glob("*.toml")))


def run(monkeypatch, folder, *arguments):
    monkeypatch.setattr(sys, "argv", ["refinement", "poisson_1p", "--out", str(folder), *arguments])
    refinement.main()
    return json.loads((folder / "summary.json").read_text())


def test_rows_that_are_not_trained_are_kept(tmp_path, monkeypatch):
    first = run(monkeypatch, tmp_path / "first", "--rows", "converged", "rtol_0.1")
    kept = str(tmp_path / "first" / "summary.json")
    both = run(monkeypatch, tmp_path / "both", "--rows", "rtol_0.01", "--keep", kept)
    assert [row["label"] for row in both["rows"]] == ["converged", "rtol_0.1", "rtol_0.01"]
    assert both["rows"][:2] == first["rows"] and both["curves"].keys() >= first["curves"].keys()
    assert all(0 < row["share_of_a_core"][0] < 1.2 for row in both["rows"])  # one thread
    base, looser, tighter = both["rows"]
    for row in (looser, tighter):  # the saving is measured against the converged row that was kept
        share = 1 - row["operator_applications"] / base["operator_applications"]
        assert row["products_saved"] == pytest.approx(share) and row["commit"] and row["machine"]
    # Each solve meets its tolerance, and no more: the tighter one takes more products, and ends nearer.
    assert looser["operator_applications"] < tighter["operator_applications"] < base["operator_applications"]
    assert looser["metric"] > tighter["metric"]


def test_a_new_converged_row_judges_the_kept_ones(tmp_path, monkeypatch):
    first = run(monkeypatch, tmp_path / "first", "--rows", "converged", "rtol_0.01")
    for row in first["rows"]:  # as if an earlier commit had needed twice the products
        if row["label"] == "converged":
            row["operator_applications"] *= 2
    first["rows"][1] |= {"products_saved": 0.99, "as_good": False}
    kept = tmp_path / "kept.json"
    kept.write_text(json.dumps(first))
    again = run(monkeypatch, tmp_path / "again", "--rows", "converged", "--keep", str(kept))
    base, row = again["rows"]
    share = 1 - row["operator_applications"] / base["operator_applications"]
    assert row["as_good"] and row["products_saved"] == pytest.approx(share)


def test_the_rows_with_multigrid_have_a_solver_of_their_own():
    rows = {row.label: row for row in refinement.rows_of(scenes.load("burgers_2d"))}
    row = rows["multigrid_rtol_0.01"]
    assert row.title == "rtol = 0.01 throughout, multigrid" and rows["rtol_0.01"].title == "rtol = 0.01 throughout"
    assert refinement.scene_of("burgers_2d", row).method == "multigrid"
    assert refinement.scene_of("burgers_2d", rows["rtol_0.01"]).method == "gmres"


def test_a_row_keeps_the_value_of_each_seed():
    scene = scenes.load("poisson_1p")
    (row,) = (row for row in refinement.rows_of(scene) if row.label == "rtol_0.1")
    for seed in (0, 1):
        row.curves.append(compare.train(scene, row.refinement, seed))
    (entry,) = compare.summarise(scene, [row])
    for name in ("operator_applications", "seconds"):
        assert len(entry["each"][name]) == 2
        assert sum(entry["each"][name]) / 2 == pytest.approx(entry[name])
    assert sum(entry["each"]["metric"]) / 2 == pytest.approx(entry["metric"])


@pytest.mark.parametrize("name", ["burgers_2d", "diffusion_inverse", *OF_BENCHMARKS])
def test_rows_with_multigrid_differ_from_the_scene_in_the_solver_alone(name):
    plain = scenes.load(name)
    (row,) = (row for row in refinement.rows_of(plain) if row.label == "multigrid")
    scene = refinement.scene_of(name, row)
    assert "multigrid" in (scene.method, scene.preconditioner) and scene.rtol == 1e-5 and scene.name == plain.name
    changed = set(scene.text.splitlines()) ^ set(plain.text.splitlines())
    assert {line.split(" = ")[0] for line in changed} <= {"method", "restart", "max_iter", "preconditioner"}
