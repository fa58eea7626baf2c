"""The pictures of a comparison, each as a matplotlib figure."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike
from PIL import Image

from prdp_torch.experiments import _C
from prdp_torch.experiments.compare import Entry, Row, verdict

Colour: TypeAlias = str | tuple[float, float, float, float]
Limits: TypeAlias = tuple[float, float]
Drawn: TypeAlias = tuple[str, Figure, str]
"""Name, figure and caption."""

WIDTH = 9.2  # inches, of every picture

# Colours that stay apart in greyscale and for colour-blind readers.
FIXED = {
    "converged": ("#222222", "-"),
    "direct": ("#7f7f7f", "--"),
    "tolerance": ("#2ca02c", "--"),
    "auto": ("#1f77b4", "-"),
    "prdp": ("#d62728", "-"),
    "growth": ("#ff9f1c", "-."),
    "schedule": ("#8c564b", ":"),
}


def _styles(kinds: list[str]) -> list[tuple[Colour, str]]:
    """Colour and line of each row by its kind; constant K run through one colour map, from coarse to fine."""
    shades = iter(np.linspace(0.05, 0.9, max(2, kinds.count("constant"))))
    return [FIXED[kind] if kind in FIXED else (matplotlib.colormaps["viridis"](next(shades)), "-") for kind in kinds]


def _styles_of(rows: list[Row]) -> list[tuple[Colour, str]]:
    return _styles([row.kind for row in rows])


def make_figure(panels: int = 1, height: float = 4.2) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(1, panels, squeeze=False)[0]


def write_png(figure: Figure, path: Path, dpi: int) -> None:
    """Write a figure as a small file, whole or not at all: without an alpha channel, as it is opaque, and compressed
    with care. ValueError if it cannot be written."""
    image, small = io.BytesIO(), io.BytesIO()
    figure.savefig(image, format="png", dpi=dpi)
    Image.open(image).convert("RGB").save(small, format="png", optimize=True, dpi=(dpi, dpi))
    _C.write_whole(path, small.getvalue())  # type: ignore[arg-type]  # it takes bytes


def error_measure(scene: _C.Scene) -> tuple[str, str]:
    """What the validation metric measures, and how."""
    if scene.task == "corrector":
        return "x-velocity error", "mean of (‖u₁ − u₁_ref‖ / ‖u₁_ref‖)²"
    return "validation error", "mean of (‖u − u_ref‖ / ‖u_ref‖)²"


def _metric_name(scene: _C.Scene) -> str:
    if scene.task == "parameters":
        return "parameter error ‖θ − θ_ref‖ / ‖θ_ref‖"
    if scene.task == "field":
        return "error of the field ‖κ − κ_ref‖ / ‖κ_ref‖"
    error, measure = error_measure(scene)
    steps = scene.data.valid_steps
    if scene.task == "corrector":
        return f"{error} at t = {steps},\n{measure}"
    return f"{error} after {steps} step{'s' if steps > 1 else ''},\n{measure}"


def mean_and_band(
    axes: Axes, x: ArrayLike, values: np.ndarray, label: str, colour: Colour, line: str, lead: bool = True
) -> None:
    """Geometric mean of `values` (seeds, x) as a line, and their spread over the seeds as a band; both end
    where a seed is no longer finite."""
    logs = np.log10(np.maximum(np.where(np.isfinite(values), values, np.nan), 1e-300))
    mean, spread = logs.mean(0), logs.std(0)
    axes.plot(x, 10**mean, color=colour, ls=line, lw=2.2 if lead else 1.3, label=label, zorder=3 if lead else 2)
    if len(logs) > 1:
        axes.fill_between(x, 10 ** (mean - spread), 10 ** (mean + spread), color=colour, alpha=0.15, lw=0)


def metric_over_intervals(scene: _C.Scene, rows: list[Row]) -> Figure:
    """Metric over epochs for every way of choosing K: geometric mean and spread over the seeds."""
    figure, (axes,) = make_figure(height=4.8)
    for row, style in zip(rows, _styles_of(rows), strict=True):
        values = row.stack("metric")
        mean_and_band(axes, range(values.shape[1]), values, row.title, *style, lead=row.kind in FIXED)
    axes.set(yscale="log", xlabel=scene.unit, ylabel=_metric_name(scene))
    axes.margins(x=0.01)
    axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure


def k_over_intervals(scene: _C.Scene, rows: list[Row]) -> Figure:
    """K over epochs, or the iterations that a solve took where K is only a cap: each seed thin, their mean bold."""
    figure, (axes,) = make_figure()
    for row, (colour, line) in zip(rows, _styles_of(rows), strict=True):
        if row.kind not in ("auto", "tolerance", "prdp", "growth", "schedule"):
            continue
        k = row.taken_per_solve() if row.capped else row.stack("max_iter")
        if len(k) > 1:
            axes.plot(k.T, color=colour, lw=0.7, alpha=0.35)
        axes.plot(k.mean(0), color=colour, ls=line, lw=2.2, label=row.title)
    axes.axhline(scene.max_iter, color="#222222", lw=1.2, label=f"converged, K = {scene.max_iter}")
    axes.set(
        xlabel=scene.unit, ylabel="K, iterations a solve may take\n(of auto, rtol: those that it took)", ylim=(0, None)
    )
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure


def total_iterations(scene: _C.Scene, rows: list[Row], table: list[Entry]) -> Figure:
    """Iterations of a whole training as bars, with what incomplete convergence (K ends below the
    converged one) and progressive refinement (K starts lower still) save of the converged run's. A row that fails or
    warns saves nothing, as in the table."""
    chosen = [entry for entry in table if entry["kind"] in ("converged", "prdp", "growth", "schedule")]
    figure, (axes,) = make_figure(height=1.6 + 0.55 * len(chosen))
    base = max(1.0, chosen[0]["budget"])
    spent = np.array([entry["budget"] / base for entry in chosen])
    verdicts = [verdict(entry) for entry in chosen]
    saved = np.array([0.0 if why else max(0.0, 1 - share) for share, why in zip(spent, verdicts, strict=True)])
    ic = np.minimum([entry["saved_by_incomplete_convergence"] for entry in chosen], saved)
    left = np.zeros(len(chosen))
    rows_down = np.arange(len(chosen))[::-1]
    for shares, colour, name in (
        (spent, "#4c72b0", "spent"),
        (saved - ic, "#dd8452", "saved by progressive refinement (PR)"),
        (ic, "#f2c6a0", "saved by incomplete convergence (IC)"),
    ):
        if not shares.any():
            continue
        bars = axes.barh(rows_down, 100 * shares, left=100 * left, color=colour, height=0.65, label=name)
        texts = [f"{100 * share:.0f} %" if share > 0.045 else "" for share in shares]
        axes.bar_label(bars, texts, label_type="center", color="white" if name == "spent" else "black")
        left += shares
    for down, share, why in zip(rows_down, spent, verdicts, strict=True):
        axes.text(100 * share + 1, down, why, va="center")
    axes.set_yticks(rows_down, [entry["title"] for entry in chosen])
    until = "" if scene.compare.target is None else f" until the error is {scene.compare.target:g}"
    axes.set_xlabel(f"% of the converged training's {base:,.0f} iterations{until}")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def pareto_front(cost: np.ndarray, error: np.ndarray) -> list[int]:
    """Indices of the points that no other beats in both, in order of cost."""
    order = np.lexsort((error, cost))
    front, best = [], np.inf
    for i in order:
        if error[i] < best:
            front.append(int(i))
            best = error[i]
    return front


_NEAR = 10  # errors within so many times the best are what a chart is about

_COSTS = (
    ("operator_applications", "products with A per sample,\nadjoint solves included"),
    ("seconds", "wall time of the training in s"),
)


def _cost_panels(scene: _C.Scene, draw: Callable[[Axes, str], None], limits: Limits | None = None) -> Figure:
    """Two panels, by products with A and by wall time; `draw(axes, cost)` fills one."""
    figure, panels = make_figure(panels=2, height=4.8)
    for axes, (cost, label) in zip(panels, _COSTS, strict=True):
        axes.set(yscale="log", xlabel=label)
        if limits is not None:  # None would keep the limits of an empty chart
            axes.set_ylim(limits)
        draw(axes, cost)
        axes.grid(alpha=0.3, which="both", lw=0.4)
        low, high = axes.get_ylim()
        if high > 10 * low:  # powers of ten suffice; other labels run into each other
            axes.yaxis.set_minor_formatter(NullFormatter())
        else:
            digits = max(2, 1 + math.ceil(math.log10(10 * high / (high - low))))  # ticks are that close
            for name in ("minor", "major"):
                getattr(axes.yaxis, f"set_{name}_formatter")(FuncFormatter(lambda y, _, n=digits: f"{y:.{n}g}"))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        if cost == "operator_applications":
            axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    panels[0].set_ylabel(_metric_name(scene))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure


def _zoom(errors: np.ndarray, spreads: np.ndarray) -> Limits | None:
    """Limits of a y axis on which errors within ten times the best are told apart. None where all are that close."""
    known = np.isfinite(errors)
    if not known.any() or errors[known].min() <= 0:
        return None
    best = errors[known].min()
    near = known & (errors <= _NEAR * best)
    if near.sum() == known.sum():
        return None
    lowest = max(best / _NEAR, (errors - spreads)[near].min())
    margin = 1.15
    return lowest / margin, (errors + spreads)[near].max() * margin


ABOVE = {"*": 4, "X": 5}  # auto and PRDP are often one point: the small mark above the large one
MARKERS = {"auto": "X", "tolerance": "v", "prdp": "*", "growth": "^", "direct": "D", "converged": "s", "schedule": "P"}


def accuracy_against_cost(scene: _C.Scene, table: list[Entry]) -> Figure:
    """Final metric against what the training cost, one point a row, with the Pareto front as stairs. Errors that are
    far above the best are arrows at the upper edge, with their values in the legend."""
    error = np.array([math.nan if entry["metric"] is None else entry["metric"] for entry in table])  # None in records
    spread = np.array([entry["metric_std"] or 0.0 for entry in table])
    limits = _zoom(error, spread)
    styles = _styles([entry["kind"] for entry in table])

    def draw(axes: Axes, name: str) -> None:
        cost = np.array([entry[name] for entry in table])
        for entry, x, y, (colour, _) in zip(table, cost, error, styles, strict=True):
            if limits and y > limits[1]:
                above = axes.get_xaxis_transform()
                label = f"{entry['title']}: {y:.2g}, above"
                axes.errorbar(x, 0.975, fmt="^", color=colour, ms=9, mec="white", mew=0.6, transform=above, label=label)
                continue
            marker = MARKERS.get(entry["kind"], "o")
            x_spread, y_spread = _spreads(entry, name)
            axes.errorbar(
                x, y, y_spread, x_spread, fmt=marker, color=colour, ms=13 if marker == "*" else 8, lw=1,
                mec="white", mew=0.6, zorder=ABOVE.get(marker, 3), label=entry["title"],
            )  # fmt: skip
        right = 1.05 * cost.max()
        front = [i for i in pareto_front(cost, error) if not limits or error[i] <= limits[1]]
        if front:  # every row may have diverged
            axes.step(
                [*cost[front], right], [*error[front], error[front[-1]]], where="post", color="#bbbbbb", lw=4,
                zorder=1, label="Pareto front",
            )  # fmt: skip
        axes.set_xlim(0, right)

    return _cost_panels(scene, draw, limits)


def _spreads(entry: Entry, cost: str) -> tuple[float | None, float | None]:
    """The error bars of a row of several seeds, along x and y. Old records have no cost of each seed."""
    if entry["seeds"] < 2:
        return None, None
    each = entry.get("each")
    if not each:
        return None, entry["metric_std"]
    if cost == "seconds":  # one of them may have waited
        low, high = np.quantile(each[cost], [0.25, 0.75])
        return float(high - low) / 2, entry["metric_std"]
    return float(np.std(each[cost], ddof=1)), entry["metric_std"]


def error_against_cost(scene: _C.Scene, rows: list[Row]) -> Figure:
    """The error as the cost of the training grows, one curve a row: means over the seeds."""

    def draw(axes: Axes, name: str) -> None:
        for row, (colour, line) in zip(rows, _styles_of(rows), strict=True):
            cost = np.concatenate([[0.0], np.cumsum(row.stack(name).mean(0))])
            lead = row.kind in FIXED
            axes.plot(
                cost, row.stack("metric").mean(0), color=colour, ls=line, lw=2.2 if lead else 1.3, label=row.title,
                zorder=3 if lead else 2,
            )  # fmt: skip
        axes.set_xlim(0, None)
        if scene.compare.target is not None:
            axes.axhline(scene.compare.target, color="#bbbbbb", lw=4, zorder=1, label="error to reach")

    return _cost_panels(scene, draw)


def _k_caption(scene: _C.Scene, rows: list[Row]) -> str:
    """Where K went, in words, from the runs themselves."""
    ends = next(row for row in rows if row.kind == "prdp").last_k()
    each = " (thin: each seed)" if len(ends) > 1 else ""
    ended = f"{ends.min():.0f}" if ends.min() == ends.max() else f"{ends.min():.0f} to {ends.max():.0f}"
    place = "below" if ends.max() < scene.max_iter else "at" if ends.min() == scene.max_iter else "around"
    return f"K over the training{each}. PRDP ends at K = {ended}, {place} the converged solver's {scene.max_iter}."


def all_charts(scene: _C.Scene, rows: list[Row], table: list[Entry]) -> list[Drawn]:
    """(name, figure, caption) of every chart, in the order of the report."""
    seeds = len(rows[0].curves)
    spread = f" (line: mean of {seeds} seeds, band: one standard deviation)" if seeds > 1 else ""
    if scene.task != "parameters":
        cost = (
            accuracy_against_cost(scene, table),
            "Accuracy against cost; lower left is better. The grey stairs join the runs that no other beats in both. "
            f"Arrows at the upper edge are errors above {_NEAR} times the best.",
        )
    else:
        cost = (error_against_cost(scene, rows), "The error against the cost so far; lower left is better.")
    drawn = [
        ("metric", metric_over_intervals(scene, rows), f"The metric over the training{spread}."),
        ("k", k_over_intervals(scene, rows), _k_caption(scene, rows)),
        (
            "iterations",
            total_iterations(scene, rows, table),
            "Iterations that the solver was allowed in all, as shares of the converged training's. K ending below "
            "the converged one saves by incomplete convergence, K starting lower still by progressive refinement. A "
            "row that fails or warns saves nothing.",
        ),
        (
            "accuracy_against_cost",
            cost[0],
            f"{cost[1]} Products with A are those of the forward and the adjoint solves; in unrolled mode, those of "
            "the sweeps back through the iterations. Wall time includes the network and the optimiser.",
        ),
    ]
    only = " One seed." if seeds == 1 else ""
    return [(name, figure, caption + only) for name, figure, caption in drawn]
