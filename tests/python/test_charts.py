"""The accuracy chart: what is near the best error is told apart, whatever K = 1 is worse by."""

import numpy as np
import pytest

from prdp_torch.experiments import charts, compare, scenes


def table_with(errors):
    """The table of heat_1d's comparison of two seeds, with these errors at the end."""
    scene = scenes.load("heat_1d")
    rows = compare.rows_of(scene)[: len(errors)]
    costs = ("operator_applications", "adjoint_applications", "seconds", "budget", "iterations")
    for row, error in zip(rows, errors, strict=True):
        spent = {name: [100.0 * (1 + row.k)] for name in costs}
        row.curves = [
            {"metric": [1.0, s * error], "error": [1.0, s * error], "max_iter": [row.k], **spent} for s in (0.98, 1.02)
        ]
    return compare.summarise(scene, rows)


def drawn(errors):
    figure = charts.accuracy_against_cost(scenes.load("heat_1d"), table_with(errors))
    figure.draw_without_rendering()
    return figure


def labels(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_the_rows_within_ten_times_the_best_have_the_axis_to_themselves():
    errors = [0.040, 0.041, 0.3, 0.042, 40.0, 0.5]
    figure = drawn(errors)
    low, high = figure.axes[0].get_ylim()
    assert [low < error < high for error in errors] == [True, True, True, True, False, False]
    # Of the height of the panel, a difference of a twentieth takes at least a fiftieth, not a two-hundredth.
    assert np.log(0.042 / 0.040) / np.log(high / low) > 0.02
    above = [label for label in labels(figure) if label.endswith("above")]
    assert above == ["PRDP, K ← 1.5 K: 40, above", "K = 1: 0.5, above"]


@pytest.mark.parametrize("errors", [[0.04, 0.05, 0.39], [0.04, np.nan, 0.05], [np.nan, np.nan]])
def test_a_chart_without_far_rows_has_no_arrows_and_shows_every_row(errors):
    figure = drawn(errors)
    assert not any(label.endswith("above") for label in labels(figure))
    low, high = figure.axes[0].get_ylim()
    assert all(low < error < high for error in errors if np.isfinite(error))


def test_a_lost_row_does_not_hide_the_others():
    low, high = drawn([0.04, np.nan, 40.0]).axes[0].get_ylim()
    assert low < 0.04 < high < 40.0


def test_a_kept_table_is_drawn_again():
    """Records of an earlier format have no values of each seed, and null where a training was lost."""
    table = table_with([0.04, 0.05])
    for entry in table:
        del entry["each"]
    table[1] |= {"metric": None, "metric_std": None}
    figure = charts.accuracy_against_cost(scenes.load("heat_1d"), table)
    figure.draw_without_rendering()
    assert "converged, K = 25" in labels(figure)


@pytest.mark.parametrize("errors", [[1.05, 1.1, 1.15], [0.04, 0.0401], [0.6, 2.0]])
def test_ticks_that_are_close_have_labels_that_differ(errors):
    for axes in drawn(errors).axes:
        low, high = axes.get_ylim()
        ticks = [*zip(axes.yaxis.get_majorticklocs(), axes.yaxis.get_majorticklabels(), strict=True),
                 *zip(axes.yaxis.get_minorticklocs(), axes.yaxis.get_minorticklabels(), strict=True)]  # fmt: skip
        shown = [(place, label.get_text()) for place, label in ticks if low <= place <= high]
        assert len(shown) > 1 and len({text for _, text in shown}) == len(shown)
        assert all(float(text) == pytest.approx(place, rel=1e-9) for place, text in shown)


def test_a_row_that_fails_or_warns_has_no_saving_in_its_bar():
    scene, table = scenes.load("heat_1d"), table_with([0.04] * 6)
    rows = compare.rows_of(scene)[:6]
    of = {entry["label"]: entry for entry in table}
    of["prdp"] |= {"warning": "the solves stop far off", "budget": 1.0}
    of["prdp_growth"] |= {"as_good": False, "budget": 1.0}
    figure = charts.total_iterations(scene, rows, table)
    figure.draw_without_rendering()
    assert [text.get_text() for text in figure.axes[0].texts if text.get_text()] == ["100 %", "warns", "fails"]
    assert labels(figure) == ["spent"]
    of["prdp"] |= {"warning": None, "saved_by_incomplete_convergence": 0.0}
    assert "saved by progressive refinement (PR)" in labels(charts.total_iterations(scene, rows, table))
