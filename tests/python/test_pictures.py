"""The pictures of docs/ are drawn from their records, and say what they leave out."""

import copy
import subprocess

import pytest

from benchmarks import charts, overview_charts, pictures, refinement_charts

OF_TRAININGS = {"kolmogorov_error", "snapshots"}  # their records are not in the repository
OF_EXAMPLES = {"first_emulator", "coarse_corrector", "inverse_permeability", "pdebench_data",
               "flow_around_cylinder", "lid_driven_cavity", "passive_scalar", "force_network"}  # fmt: skip


def tracked(pattern):
    listed = subprocess.run(["git", "ls-files", pattern], cwd=pictures.DOCS.parent, capture_output=True, text=True)
    return {pictures.DOCS.parent / name for name in listed.stdout.split()}


def test_every_picture_is_drawn_again_from_a_record():
    drawn = {path for path, _, _ in pictures.all_of_them()}
    left = tracked("docs/*.png") - drawn
    assert {path.stem for path in left} <= OF_TRAININGS | OF_EXAMPLES


def test_every_picture_is_on_a_page():
    pages = "".join(path.read_text() for path in tracked("*.md"))
    assert not [path.name for path in tracked("docs/*.png") if path.exists() and f"/{path.name})" not in pages]


def test_every_picture_shows_its_record():
    old = [path.name for path, dpi, draw in pictures.all_of_them() if not pictures.is_drawn(path, dpi, draw())]
    assert not old, "run: python -m benchmarks.pictures"


def test_a_picture_of_another_record_is_not_drawn(tmp_path):
    path, dpi, draw = next(iter(pictures.all_of_them()))
    figure = draw()
    assert pictures.is_drawn(path, dpi, figure) and not pictures.is_drawn(tmp_path / "none.png", dpi, figure)
    figure.axes[0].set_xlim(0, 2 * figure.axes[0].get_xlim()[1])
    assert not pictures.is_drawn(path, dpi, figure)


def test_scenes_of_one_seed_are_marked():
    found = refinement_charts.summaries()
    figure = refinement_charts.error_against_products(found)
    titles = {axes.get_title() for axes in figure.axes}
    assert len(titles) == len(found)
    for name, summary in found.items():
        seeds = {row["seeds"] for row in summary["rows"]}
        assert (f"{name} (one seed)" in titles) == (seeds == {1})


def test_an_error_far_above_the_others_does_not_flatten_a_panel():
    summary = copy.deepcopy(refinement_charts.summaries()["heat_1d"])
    summary["rows"][2]["metric"] *= 1e5
    (axes,) = refinement_charts.error_against_products({"heat_1d": summary}).axes
    assert axes.get_ylim()[1] < 2
    assert any("e+04" in text.get_text() or "e+05" in text.get_text() for text in axes.texts)


def test_the_marks_of_a_scene_are_its_shares_of_the_converged_products():
    found = {"heat_2d": refinement_charts.summaries()["heat_2d"]}
    rows = {row["label"]: row for row in found["heat_2d"]["rows"]}
    (axes,) = overview_charts.products(found).axes
    marks = {float(x): dots.get_facecolor()[0] for dots in axes.collections for x, _ in dots.get_offsets()}
    shares = [rows[label]["operator_applications"] / rows["converged"]["operator_applications"]
              for label in ("auto", "prdp", "rtol_0.01")]  # fmt: skip
    assert list(marks) == pytest.approx(shares)
    hollow = [tuple(colour[:3]) == (1.0, 1.0, 1.0) for colour in marks.values()]
    assert hollow == [False, True, False]  # tuned PRDP fails there


def test_a_bar_ends_at_its_error_or_names_it():
    found = pictures.read(pictures.DOCS / "results" / "heat_1d.json")
    (axes,) = overview_charts.errors(found, highest=2.0).axes
    rows, limit = found["rows"], 2.0 * found["rows"][0]["metric"]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([min(row["metric"], limit) for row in rows])
    beside = {text.get_text().strip() for text in axes.texts}
    assert {f"{row['metric']:.2g}" for row in rows if row["metric"] >= limit} <= beside


def test_the_bars_of_an_update_have_one_length():
    found = [
        {"scene": "a", "k": 1, "network_seconds": 1e-3, "update_seconds": 1e-2},
        {"scene": "b", "k": 1, "network_seconds": 1.02, "update_seconds": 1.0},  # within the noise
    ]
    (axes,) = charts.training(found).axes
    ends = [bar.get_x() + bar.get_width() for bar in axes.patches]
    assert max(ends) == pytest.approx(100)
    assert [text.get_text() for text in axes.texts] == ["below 5 % of 1.00 s", "90 % of 10 ms"]
