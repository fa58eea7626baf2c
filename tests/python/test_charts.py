"""The accuracy chart: what is near the best error is told apart, whatever K = 1 is worse by."""

import numpy as np
import pytest

from prdp_torch.experiments import charts, compare, scenes


def rows_with(errors):
    """Rows of heat_1d's comparison of two seeds, with these errors at the end."""
    rows = compare.rows_of(scenes.load("heat_1d"))[: len(errors)]
    for row, error in zip(rows, errors, strict=True):
        costs = {name: [100.0 * (1 + row.k)] for name in ("operator_applications", "seconds", "budget", "iterations")}
        row.curves = [{"metric": [1.0, s * error], "max_iter": [row.k], **costs} for s in (0.98, 1.02)]
    return rows


def panels(errors):
    """The limits of the y axes of the left column, from below."""
    figure = charts.accuracy_against_cost(scenes.load("heat_1d"), rows_with(errors))
    figure.draw_without_rendering()
    left = [axes for axes in figure.axes if axes.get_subplotspec().colspan.start == 0]
    return [axes.get_ylim() for axes in left[::-1]]


def test_the_rows_within_ten_times_the_best_have_a_panel_to_themselves():
    errors = [0.040, 0.041, 0.3, 0.042, 40.0, 0.5]
    near, far = panels(errors)
    inside = [near[0] < error < near[1] for error in errors]
    assert inside == [True, True, True, True, False, False]
    assert all(far[0] < error < far[1] for error in (40.0, 0.5)) and near[1] <= far[0]
    # Of the height of its panel, a difference of a twentieth takes at least a fiftieth, not a two-hundredth.
    assert np.log(0.042 / 0.040) / np.log(near[1] / near[0]) > 0.02


@pytest.mark.parametrize("errors", [[0.04, 0.05, 0.39], [0.04, np.nan, 0.05], [np.nan, np.nan]])
def test_a_chart_without_far_rows_is_whole(errors):
    assert len(panels(errors)) == 1


def test_a_lost_row_does_not_hide_the_others():
    near, _ = panels([0.04, np.nan, 40.0])
    assert near[0] < 0.04 < near[1] < 40.0
