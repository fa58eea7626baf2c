"""`python -m benchmarks.refinement_charts`: the pictures of docs/refinement_records.md and docs/study_time.md,
from the records in docs/results."""

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from prdp_torch.experiments.charts import write_png

RESULTS = Path(__file__).parents[1] / "docs" / "results"
ROWS = {  # label: title, colour, marker
    "converged": ("converged", "#222222", "*"),
    "prdp": ("PRDP, tuned", "#d62728", "o"),
    "prdp_defaults": ("PRDP, defaults", "#ff9f1c", "v"),
    "tolerance": ("tolerance", "#7f7f7f", "s"),
    "tolerance_adjoint": ("tolerance, adjoint looser", "#2ca02c", "D"),
    "auto": ("auto", "#1f77b4", "P"),
}
FOLLOWED = ("heat_1d", "burgers_2d", "diffusion_inverse")


def summaries():
    """The records by scene."""
    paths = sorted(RESULTS.glob("refinement_*.json"))
    return {path.stem.removeprefix("refinement_"): json.loads(path.read_text()) for path in paths}


def error_against_cost(found):
    """Every scene in one picture: error, products and seconds as ratios to the converged row's."""
    figure = Figure(figsize=(9.2, 4.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, cost in zip(panels, ("operator_applications", "seconds"), strict=True):
        for label, (title, colour, marker) in ROWS.items():
            points = [point for summary in found.values() if (point := _ratios(summary, label, cost))]
            if label == "converged":
                points = points[:1]
            axes.scatter([], [], color=colour, marker=marker, s=36, label=title)
            for *point, is_claimed in points:
                axes.scatter(*point, **_marker(colour, marker, is_claimed), alpha=0.8)
        axes.set(xscale="log", yscale="log")
        axes.axhspan(0.0, 1.1, color="#e8f4e8", zorder=0, lw=0)
        axes.grid(alpha=0.3, lw=0.4)
        axes.xaxis.set_major_locator(FixedLocator([0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 4.0]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
    panels[0].set(xlabel="products with A, converged = 1", ylabel="error, converged = 1")
    panels[1].set(xlabel="seconds, converged = 1")
    panels[0].legend(frameon=False, fontsize=8)
    title = f"{len(found)} scenes: error against work. Green: at most a tenth above the converged error"
    figure.suptitle(f"{title}. Hollow: fails or warns")
    return figure


def _ratios(summary, label, cost):
    base = summary["rows"][0]
    row = next(row for row in summary["rows"] if row["label"] == label)
    if row["diverged"]:
        return None
    return row[cost] / base[cost], row["metric"] / base["metric"], _claims(row)


def _claims(row):
    return row["as_good"] and not row["warnings"]


def _marker(colour, marker, is_claimed):
    """Hollow where the row claims nothing."""
    return {"marker": marker, "s": 36, "facecolors": colour if is_claimed else "none", "edgecolors": colour}


def time_against_products(found):
    """What is saved of the products, and of the seconds with network and optimiser: one point per scene, hollow where
    the row fails or warns."""
    figure = Figure(figsize=(6.2, 4.6), layout="constrained")
    axes = figure.subplots()
    for label in ("prdp", "auto"):
        title, colour, marker = ROWS[label]
        axes.scatter([], [], color=colour, marker=marker, s=36, label=title)
        for name, summary in found.items():
            row, base = next(row for row in summary["rows"] if row["label"] == label), summary["rows"][0]
            saved = [100 * (1 - row[cost] / base[cost]) for cost in ("operator_applications", "seconds")]
            axes.scatter(*saved, **_marker(colour, marker, _claims(row)))
            if label == "auto":  # those below zero are named to the right, out of the way of the others
                place = {"xytext": (0, 6), "rotation": 60} if saved[1] > -3 else {"xytext": (7, -3)}
                axes.annotate(name, saved, **place, textcoords="offset points", fontsize=8)
    axes.axline((0, 0), slope=1, color="#888888", lw=1, ls="--")
    axes.set(xlabel="products saved, %", ylabel="time saved, %", xlim=(0, 100), ylim=(None, 100))
    axes.axhline(0, color="#888888", lw=1)
    axes.grid(alpha=0.3, lw=0.4)
    axes.scatter([], [], **_marker("#444444", "o", False), label="fails or warns")
    axes.legend(frameon=False, loc="upper left")
    return figure


def over_the_training(found):
    """Iterations of a solve, and the tolerance, interval by interval."""
    figure = Figure(figsize=(9.2, 5.0), layout="constrained")
    panels = figure.subplots(2, len(FOLLOWED), sharex="col", squeeze=False)
    for (above, below), name in zip(panels.T, FOLLOWED, strict=True):
        for label in ("converged", "prdp", "auto"):
            title, colour, _ = ROWS[label]
            curves = found[name]["curves"][label]
            intervals = np.arange(1, 1 + len(curves["rtol"]))
            above.plot(intervals, curves["iterations"], color=colour, label=title)
            below.plot(intervals, curves["rtol"], color=colour, label=title)
        above.set(title=name, yscale="log")
        below.set(yscale="log", xlabel="interval")
        for axes in (above, below):
            axes.grid(alpha=0.3, lw=0.4)
        above.yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        above.yaxis.set_minor_formatter(FuncFormatter(lambda x, _: ""))
    panels[0, 0].set_ylabel("iterations of a solve")
    panels[1, 0].set_ylabel("rtol of the forward solves")
    panels[0, 0].legend(frameon=False, fontsize=8)
    return figure


FIVE = {  # label: title, colour
    "converged": ("converged", "#222222"),
    "multigrid": ("converged, with multigrid", "#9467bd"),
    "rtol_0.01": ("rtol = 1e-2 throughout", "#2ca02c"),
    "prdp": ("PRDP, tuned", "#d62728"),
    "auto": ("auto", "#1f77b4"),
}


def error_over_cost(summary):
    """The validation error of one scene against the seconds and the products spent so far."""
    figure = Figure(figsize=(9.2, 3.8), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, cost, title in zip(
        panels, ("seconds", "operator_applications"), ("seconds of training", "products with A"), strict=True
    ):
        for label, (name, colour) in FIVE.items():
            curves = summary["curves"][label]
            spent = np.cumsum(curves[cost])
            axes.plot(spent, curves["metric"][1:], color=colour, lw=1.6, label=name)
            axes.plot(spent[-1], curves["metric"][-1], "o", color=colour, ms=5)
        axes.set(yscale="log", xlabel=title)
        axes.grid(alpha=0.3, lw=0.4)
        axes.ticklabel_format(axis="x", scilimits=(-3, 5))
    panels[0].set_ylabel("validation error")
    panels[1].legend(frameon=False, fontsize=9)
    figure.suptitle(f"{summary['settings']['scene']}: what an error costs (one seed; the dots are the ends)")
    return figure


def main():
    found = summaries()
    write_png(error_over_cost(found["burgers_2d"]), RESULTS / "burgers_2d_cost.png", dpi=110)
    write_png(error_against_cost(found), RESULTS / "refinement.png", dpi=110)
    write_png(time_against_products(found), RESULTS / "time_saved.png", dpi=110)
    write_png(over_the_training(found), RESULTS / "refinement_training.png", dpi=110)


if __name__ == "__main__":
    main()
