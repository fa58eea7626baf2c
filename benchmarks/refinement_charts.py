"""`python -m benchmarks.refinement_charts`: the pictures of trainings on the pages of docs, from the records in
docs/results."""

import json
import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from benchmarks import readme_picture
from docs.record_rows import NOISE_OF_TIME, by_label, claims, share_of_products, share_of_seconds
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
CONSTANT = "#9467bd"  # of the rows with one tolerance throughout
GREEN = "#e8f4e8"
HIGHEST = 3  # times the converged error; what is above has an arrow
PANEL = (208, 150)  # points, of the panels side by side
FOLLOWED = ("heat_1d", "burgers_2d", "diffusion_inverse")


def summaries():
    """The records by scene."""
    paths = sorted(RESULTS.glob("refinement_*.json"))
    return {path.stem.removeprefix("refinement_"): json.loads(path.read_text()) for path in paths}


def error_against_products(found):
    """One panel for each scene: the error and the products as ratios to the converged row's."""
    height = math.ceil(len(found) / 3)
    figure = Figure(figsize=(9.2, 1.0 + 2.3 * height), layout="constrained")
    panels = figure.subplots(height, 3, squeeze=False).ravel()
    for axes, (name, summary) in zip(panels, found.items(), strict=False):
        _panel(axes, summary)
        axes.set_title(f"{name} ({seeds_of(summary['rows'])})", fontsize=10)
    for axes in panels[len(found) :]:
        axes.remove()
    figure.supxlabel("products with A, converged = 1", fontsize=10)
    figure.supylabel("error, converged = 1", fontsize=10)
    handles = [_legend_entry(colour, marker, title) for title, colour, marker in ROWS.values()]
    handles.append(_legend_entry("#444444", "o", "hollow: fails or warns", hollow=True))
    handles.append(Line2D([], [], color=GREEN, lw=8, label="at most a tenth above converged"))
    handles.append(_legend_entry("#444444", 6, "above the panel, with its error"))
    if any(row["label"].startswith("rtol_") for summary in found.values() for row in summary["rows"]):
        handles.append(Line2D([], [], color=CONSTANT, marker="o", ms=4, label="one rtol throughout"))
    figure.legend(handles=handles, loc="outside upper center", ncols=5, frameon=False, fontsize=8)
    return figure


def _panel(axes, summary):
    base = summary["rows"][0]
    shown = [row for row in summary["rows"] if row["label"] in ROWS or row["label"].startswith("rtol_")]
    errors = [_error(row, base) for row in shown]
    low, high = min(0.8, *errors) / 1.3, 1.2 * max(1.3, *(error for error in errors if error <= HIGHEST))
    axes.axhspan(low, 1.1, color=GREEN, zorder=0, lw=0)
    constants = [row for row in shown if row["label"] not in ROWS]
    x, y = [_products(row, base) for row in constants], [_error(row, base) for row in constants]
    axes.plot(x, y, color=CONSTANT, lw=1, zorder=2)
    for row, at, error in zip(constants, x, y, strict=True):
        fill = CONSTANT if claims(row) else "white"
        axes.plot(at, error, "o", color=CONSTANT, mfc=fill, ms=4, zorder=2)
    for label, (_, colour, marker) in ROWS.items():
        for row in shown:
            if row["label"] == label:
                _point(axes, row, base, high, colour, marker)
    axes.set(xscale="log", yscale="log", ylim=(low, high))
    place = _points_of(axes)
    taken = [place(_products(row, base), error) for row, error in zip(shown, errors, strict=True) if error <= high]
    for row, at, error in zip(constants, x, y, strict=True):
        if error <= high:
            taken.append(_label(axes, row["label"][5:], (at, error), place(at, error), taken))
    axes.grid(alpha=0.3, lw=0.4)
    _plain(axes.xaxis, [0.05, 0.1, 0.2, 0.5, 1, 2, 4])
    _plain(axes.yaxis, [0.1, 0.2, 0.5, 0.7, 1, 1.5, 2, 3])
    axes.tick_params(labelsize=8)


def _points_of(axes):
    """The function that says how many points a value is from the lower left corner of a logarithmic panel."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    return lambda x, y: np.array(PANEL) * (math.log(x / left, right / left), math.log(y / low, high / low))


def _label(axes, text, point, place, taken):
    """Write the text on that side of the point where the nearest of the taken places, beside its own, is the farthest.
    Returns the place of its middle."""
    others = [other for other in taken if (other != place).any()]

    def room(side):
        middle = place + side
        inside = (middle > (10, 4)).all() and (middle < np.array(PANEL) - (10, 4)).all()
        return min((float(np.hypot(*((middle - other) / (2, 0.6)))) for other in others), default=1e3) if inside else 0

    side = max(((12, 7), (12, -7), (-12, 7), (-12, -7), (0, 9), (0, -9)), key=room)
    style = {"textcoords": "offset points", "ha": "center", "va": "center", "fontsize": 6, "zorder": 4}
    axes.annotate(text, point, xytext=side, **style)
    return place + side


def _products(row, base):
    return row["operator_applications"] / base["operator_applications"]


def _error(row, base):
    return math.inf if row["diverged"] else row["metric"] / base["metric"]


def _point(axes, row, base, high, colour, marker):
    """A row, or an arrow with its error where that is above the panel."""
    at, error = _products(row, base), _error(row, base)
    if error <= high:
        axes.scatter(at, error, **_marker(colour, marker, claims(row)), zorder=3)
        return
    axes.plot(at, 0.93, marker=6, ms=8, color=colour, transform=axes.get_xaxis_transform())
    beside = {"xytext": (7, 0), "textcoords": "offset points", "va": "center", "fontsize": 8, "color": colour}
    beside["bbox"] = {"fc": "white", "ec": "none", "pad": 0.5, "alpha": 0.8}
    text = f"{error:.2g}" if math.isfinite(error) else f"{row['diverged']} of {row['seeds']} diverged"
    axes.annotate(text, (at, 0.93), xycoords=axes.get_xaxis_transform(), **beside)


def _plain(axis, ticks):
    """These ticks, written as plain numbers."""
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_locator(NullLocator())


def seeds_of(rows):
    """How many seeds they have, in words."""
    counts = sorted({row["seeds"] for row in rows})
    several = " to ".join(map(str, counts[:: len(counts) - 1] if len(counts) > 1 else counts))
    return "one seed" if counts == [1] else f"{several} seeds"


def _legend_entry(colour, marker, title, hollow=False):
    face = "none" if hollow else colour
    return Line2D([], [], ls="", color=colour, marker=marker, mfc=face, ms=6, label=title)


def _marker(colour, marker, is_claimed):
    """Hollow where the row claims nothing."""
    return {"marker": marker, "s": 36, "facecolors": colour if is_claimed else "none", "edgecolors": colour}


def time_against_products(found):
    """What auto and tuned PRDP save: a line for each, from the seconds to the products, hollow where the row fails
    or warns."""
    figure = Figure(figsize=(8.0, 1.2 + 0.5 * len(found)), layout="constrained")
    axes = figure.subplots()
    titles = []
    for at, (name, summary) in enumerate(found.items()):
        rows = {label: row for label, row in by_label(summary).items() if label in ("converged", "prdp", "auto")}
        base = rows["converged"]
        titles.append(f"{name} ({seeds_of(rows.values())})")
        for label, shift in (("auto", -0.16), ("prdp", 0.16)):
            _, colour, _ = ROWS[label]
            row = rows.get(label)
            if row is None:
                continue
            products, seconds = (100 * share(row, base) for share in (share_of_products, share_of_seconds))
            marks = [(products, "o")]
            if row["seeds"] == base["seeds"]:  # rows of fewer seeds are older, and of another machine
                marks.append((seconds, "D"))
                axes.plot([seconds, products], [at + shift] * 2, color=colour, lw=1, alpha=0.6, zorder=1)
            for saved, marker in marks:
                # White inside, so that the line does not run through a hollow one.
                fill = colour if claims(row) else "white"
                axes.scatter(saved, at + shift, marker=marker, s=36, facecolors=fill, edgecolors=colour, zorder=2)
    axes.set_yticks(range(len(found)), titles)
    axes.invert_yaxis()
    axes.axvline(0, color="#888888", lw=1, zorder=0)
    axes.axvspan(-100 * NOISE_OF_TIME, 100 * NOISE_OF_TIME, color="#eeeeee", lw=0, zorder=-1)
    axes.set(xlabel="saved of the converged training, %. Grey: the noise of the seconds", xlim=(-30, 100))
    axes.grid(alpha=0.3, lw=0.4, axis="x")
    axes.spines[["top", "right", "left"]].set_visible(False)
    handles = [Line2D([], [], color=ROWS[label][1], lw=3, label=ROWS[label][0]) for label in ("auto", "prdp")]
    for marker, title in (("o", "products with A"), ("D", "seconds")):
        handles.append(_legend_entry("#444444", marker, title))
    handles.append(_legend_entry("#444444", "o", "hollow: fails or warns", hollow=True))
    figure.legend(handles=handles, loc="outside upper center", ncols=5, frameon=False, fontsize=9)
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
    figure.suptitle("One seed of each scene", fontsize=11)
    return figure


def figures():
    """(file name, figure) of each picture."""
    found = summaries()
    yield "readme.png", readme_picture.draw(found)
    yield "refinement_panels.png", error_against_products(found)
    yield "time_saved.png", time_against_products(found)
    yield "refinement_training.png", over_the_training(found)


def main():
    for name, figure in figures():
        write_png(figure, RESULTS / name, dpi=110)


if __name__ == "__main__":
    main()
