"""What needs no tuning: auto on scenes that nobody tuned, its warnings, and comparisons that name failures."""

import re

import numpy as np
import pytest
from helpers import written

from prdp_torch.controller import PRDPController
from prdp_torch.experiments import compare, report, scenes
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

CONVERGED = ("max_iter = 25", "max_iter = 2000")  # rtol = 1e-5 ends the solves
VARIANTS = {
    "finer and stiffer": [("shape = [30]", "shape = [50]"), ("nu = 1e-3", "nu = 5e-3")],
    "longer time step": [("dt = 1.0", "dt = 10.0")],
    "other data and viscosity": [("nu = 1e-3", "nu = 3e-3"), ("seed = 0", "seed = 3")],
    "unrolled, shorter time step": [("dt = 1.0", "dt = 0.3"), ('"implicit"', '"unrolled"')],
}
DEFAULTS = Refinement("defaults", PRDPController)


def ends(scene, refinement, seeds=3):
    """The final metrics and the mean of the products with A, and how many controllers warned."""
    curves = [train(scene, refinement, seed) for seed in range(seeds)]
    products = np.mean([sum(c["operator_applications"]) for c in curves])
    return np.array([c["metric"][-1] for c in curves]), products, sum("warning" in c for c in curves)


@pytest.mark.parametrize("name", VARIANTS)
def test_auto_ends_like_converged_solves_on_scenes_that_nobody_tuned(tmp_path, name):
    scene = scenes.load(written(tmp_path, CONVERGED, *VARIANTS[name], scene="heat_1d"))
    converged, most, _ = ends(scene, Refinement.constant(scene.max_iter))
    auto, products, warned = ends(scene, Refinement.auto())
    assert auto.mean() <= converged.mean() + converged.std(ddof=1)
    assert products < 0.5 * most and not warned


@pytest.mark.parametrize("name", VARIANTS)
def test_prdp_with_its_defaults_ends_like_converged_solves_or_warns(tmp_path, name):
    scene = scenes.load(written(tmp_path, CONVERGED, *VARIANTS[name], scene="heat_1d"))
    converged, _, false_alarms = ends(scene, Refinement.constant(scene.max_iter))
    defaults, _, warned = ends(scene, DEFAULTS)
    spread = max(defaults.std(ddof=1), converged.std(ddof=1))
    good = defaults.mean() <= converged.mean() + spread
    assert good or warned == len(defaults)
    assert not false_alarms


def test_a_constant_k_that_is_given_twice_is_trained_once(tmp_path):
    scene = scenes.load(
        written(tmp_path, ("constant = [1, 2, 3, 5, 7, 10, 15, 25]", "constant = [2, 2]"), scene="heat_1d")
    )
    assert [row.label for row in compare.rows_of(scene)].count("constant_2") == 1


def test_a_row_whose_solves_still_fail_in_the_end_warns():
    row = compare.Row("converged", "converged", "converged", DEFAULTS)
    row.curves += [{"failed": [6, 0]}, {"failed": [0, 1206]}, {"failed": [2], "warning": "the error grows"}]
    assert row.warnings() == ["solves of 1,206 samples failed in the last interval", "the error grows"]


def test_a_fall_in_the_metric_is_no_proof():
    """PRDP's defaults stop at K = 18 where the unknowns make up for the solver's error: the misfit is small."""
    scene = scenes.load("poisson_3p")
    lost, auto = train(scene, DEFAULTS), train(scene, Refinement.auto())
    assert lost["metric"][-1] > 0.1 and "PRDPController: the solves stop at a residual of" in lost["warning"]
    converged = train(scene, Refinement.constant(scene.max_iter))
    assert auto["metric"][-1] <= 1.05 * converged["metric"][-1] and "warning" not in auto
    assert sum(auto["operator_applications"]) < 0.7 * sum(converged["operator_applications"])


def test_a_scene_needs_no_prdp_table(tmp_path):
    text = scenes.available()["heat_1d"].read_text()
    start = text.index("[prdp]")
    path = tmp_path / "untuned.toml"
    path.write_text(text[:start] + text[text.index("[compare]") :])
    assert scenes.load(path).prdp == PRDPController().settings


@pytest.fixture(scope="module")
def untuned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("untuned")
    scene = scenes.load(
        written(
            folder,
            CONVERGED,
            *VARIANTS["finer and stiffer"],
            ("constant = [1, 2, 3, 5, 7, 10, 15, 25]", "constant = [10]"),
            scene="heat_1d",
        )
    )
    rows = compare.run(scene, 2, folder)
    return scene, rows, {entry["label"]: entry for entry in compare.summarise(scene, rows)}


def test_a_comparison_judges_savings_only_of_rows_that_end_as_well(untuned):
    scene, _, table = untuned
    assert [label for label in ("converged", "direct", "auto") if not table[label]["as_good"]] == []
    assert not table["prdp"]["as_good"] and not table["constant_10"]["as_good"]
    shown = {label: report.cells(scene, entry) for label, entry in table.items()}
    saved = [column.short for column in report.columns(scene)].index("saved")
    assert shown["prdp"][saved] == shown["constant_10"][saved] == "fails" and shown["prdp"][0] == "PRDP !"
    assert shown["auto"][saved] == f"{100 * table['auto']['products_saved']:.1f} %"
    assert table["auto"]["products_saved"] > 0.6
    warned = table["auto"] | {"warning": "the solves stop too far off", "warnings": 1}
    assert report.cells(scene, warned)[saved] == "warns"


def test_a_failure_is_named_and_no_headline(untuned):
    scene, _, table = untuned
    entries = list(table.values())
    headline = report.headline(scene, entries)
    assert "auto ends at an error of" in headline
    assert re.search(r"% fewer products with A; [\d.e-]+ s, where converged solves take [\d.e-]+ s\.", headline)
    assert headline.endswith("it fails.") and headline.count("fewer") == 1
    first, *warnings = report.failures(scene, entries)
    assert first.startswith("Do not reach the error of K = 2000: PRDP") and first.endswith("K = 10.")
    assert warnings[0].startswith("! PRDP, 2 of 2 seeds: ") and "the solves stop at a residual of" in warnings[0]


def test_the_products_of_a_row_are_those_of_its_solves(untuned):
    scene, rows, table = untuned
    for row in rows:
        entry = table[row.label]
        forward = entry["operator_applications"] - entry["adjoint_applications"]
        assert forward > 0 and entry["adjoint_applications"] > 0
        curves = row.curves[0]
        assert len(curves["adjoint_applications"]) == len(curves["rtol"]) == len(curves["seconds"])
    assert table["auto"]["saved"] is None  # K is a cap
    auto = next(row for row in rows if row.label == "auto")
    rtol, metric = (np.array(auto.curves[0][name]) for name in ("rtol", "metric"))
    error = np.sqrt(metric[:-1]) / scene.data.valid_steps  # of one step
    np.testing.assert_allclose(rtol, 0.1 * np.minimum(1, np.minimum.accumulate(error)), rtol=1e-6)
    assert (auto.taken_per_solve() < 200).all()
