"""What a task without a network has found: θ beside the record, in both languages, and its picture."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import small_darcy, small_field, written

from prdp_torch.experiments import _C, compare, found, records, scenes
from prdp_torch.experiments.networks import Theta
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

ROOT = Path(__file__).parents[2]


def poisson(tmp_path):
    return written(tmp_path, ("updates = 750", "updates = 20"), scene="poisson_3p", name="small")


def error_of(scene, theta):
    if scene.task == "field":
        return float(_C.relative_error(theta.exp(), _C.make_field_problem(scene, 0).reference))
    return float(_C.relative_error(theta, _C.make_parameter_problem(scene).reference))


@pytest.mark.parametrize("make", [small_field, small_darcy, poisson])
def test_both_languages_keep_it(tmp_path, make):
    path = make(tmp_path)
    scene = scenes.load(path)
    command = [ROOT / "build/prdp_train", path, "--out", tmp_path / "cpp", "--constant", "4"]
    assert subprocess.run(command, capture_output=True).returncode == 0
    refinement = Refinement.constant(4)
    curves = compare.run_one(scene, "constant_4", refinement, 0, tmp_path / "py", records.environment(scene.device))
    kept = [torch.load(tmp_path / language / "constant_4/seed_0.pt") for language in ("cpp", "py")]
    assert [list(state) for state in kept] == [["theta"]] * 2
    cpp, python = (state["theta"] for state in kept)
    assert python.dtype == scene.dtype
    torch.testing.assert_close(cpp, python, rtol=1e-3, atol=1e-4)
    assert error_of(scene, python) == pytest.approx(curves["metric"][-1], rel=1e-6)
    for language in ("cpp", "py"):  # the record knows its fingerprint
        record = tmp_path / language / "constant_4/seed_0.json"
        assert torch.equal(records.read_weights(record, Theta(scene)).theta, kept[language == "py"]["theta"])


def test_a_training_leaves_it_in_a_theta(tmp_path):
    scene = scenes.load(small_field(tmp_path))
    theta = Theta(scene)
    curves = train(scene, Refinement.constant(4), network=theta)
    assert error_of(scene, theta.theta.detach()) == pytest.approx(curves["metric"][-1], rel=1e-6)
    assert train(scene, Refinement.constant(4)) | {"seconds": 0} == curves | {"seconds": 0}
    with pytest.raises(ValueError, match="the task 'field' trains no network: it takes no data, and as network a"):
        train(scene, Refinement.constant(4), network=torch.nn.Linear(2, 2))


def test_where_it_is_missing_the_training_is_run_again(tmp_path):
    scene = scenes.load(small_field(tmp_path))
    scene.training.intervals = 3
    arguments = (scene, "constant_4", Refinement.constant(4), 0, tmp_path, records.environment(scene.device))
    once = compare.run_one(*arguments)
    kept = tmp_path / "constant_4/seed_0.pt"
    before = kept.read_bytes()
    kept.unlink()
    assert compare.run_one(*arguments, resume=True)["metric"] == once["metric"] and kept.read_bytes() == before


def in_3d(tmp_path):
    return small_field(tmp_path, ("shape = [10, 12]", "shape = [4, 5, 6]"))


@pytest.mark.parametrize("make", [small_field, small_darcy, poisson, in_3d])
def test_the_report_shows_it(tmp_path, make):
    path = make(tmp_path)
    command = [sys.executable, "-m", "prdp_torch", "compare", path, "--seeds", "1", "--intervals", "3"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "runs/small"
    assert (folder / "found.png").exists() and "What was found" in (folder / "report.html").read_text()


def test_the_picture_holds_what_was_found(tmp_path):
    """The numbers in the panels; a training that diverged, or left no θ, has none."""
    scene = scenes.load(small_field(tmp_path))
    scene.training.intervals = 3
    rows = [row for row in compare.rows_of(scene) if row.kind in ("converged", "auto", "prdp")]
    for row in rows:
        environment = records.environment(scene.device)
        row.curves.append(compare.run_one(scene, row.label, row.refinement, 0, tmp_path, environment))
    ((name, figure, _),) = found.pictures(scene, rows, tmp_path)
    images = [axes.images[0] for axes in figure.axes if axes.images]
    theta = torch.load(tmp_path / "auto/seed_0.pt")["theta"]
    reference = _C.make_field_problem(scene, 0).reference
    assert name == "found" and len(images) == 7
    np.testing.assert_allclose(images[0].get_array(), reference)
    np.testing.assert_allclose(images[2].get_array(), theta.exp())
    np.testing.assert_allclose(images[5].get_array(), theta.exp() - reference)

    rows[0].curves[0]["diverged"] = "interval 1"
    (tmp_path / "prdp/seed_0.pt").unlink()
    ((_, figure, _),) = found.pictures(scene, rows, tmp_path)
    assert [axes.get_title() for axes in figure.axes if axes.get_title()] == ["to be found", "auto"]
    (tmp_path / "auto/seed_0.pt").unlink()
    assert found.pictures(scene, rows, tmp_path) == []
