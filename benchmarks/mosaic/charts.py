"""The pictures of the tasks: each a matplotlib figure, made from the rows of a record."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from benchmarks.mosaic import solvers

# Okabe and Ito's colours, which colour-blind readers can tell apart: one per library, a dash per variant.
STYLES = {
    "ours": ("#D55E00", "-", "o"),
    "ours_direct": ("#D55E00", "--", "o"),
    "ours_recomputed": ("#D55E00", ":", "o"),
    "jax_cfd": ("#0072B2", "--", "^"),
    "jax_cfd_central": ("#0072B2", "-", "^"),
    "jax_cfd_cg": ("#0072B2", ":", "^"),
    "phiflow": ("#009E73", "--", "s"),
    "phiflow_central": ("#009E73", "-", "s"),
    "exponax": ("#CC79A7", "-", "D"),
    "exponax_stored": ("#CC79A7", ":", "D"),
    "torch_fem": ("#009E73", "-", "s"),
    "scipy": ("#222222", "-", "D"),
}


def of(task, rows):
    """{file name: figure} of a task; nothing where there is nothing to draw."""
    rows = [row for row in rows if "result" in row]
    return DRAWN[task](rows) if rows and task in DRAWN else {}


def cost(rows):
    found = {}
    for dim in (2, 3):
        of_dim = [row for row in rows if row["case"]["dim"] == dim]
        if of_dim:
            found[f"cost_{dim}d"] = _cost(of_dim, dim)
    return found


PARTS = (  # of a result, with the name of the axis and what it is scaled by
    ("forward_seconds", "rollout, seconds", 1.0),
    ("gradient_seconds", "rollout and gradient, seconds", 1.0),
    ("gradient_bytes", "rollout and gradient, MB at the peak", 1e-6),
)


def _cost(rows, dim):
    """Columns: against N with the number of steps that most cases share, against steps with their N."""
    steps, n = _usual(rows, "steps"), _usual(rows, "n")
    figure = Figure(figsize=(10.5, 10), layout="constrained")
    panels = figure.subplots(3, 2, sharey="row", sharex="col")
    for panel_row, (part, name, scale) in zip(panels, PARTS, strict=True):
        for axes, along, fixed, value in zip(panel_row, ("n", "steps"), ("steps", "n"), (steps, n), strict=True):
            _lines(axes, [row for row in rows if row["case"][fixed] == value], along, part, scale)
        panel_row[0].set(ylabel=name)
    panels[-1, 0].set(xlabel=f"N, {steps} steps")
    panels[-1, 1].set(xlabel=f"steps, N = {n}")
    figure.suptitle(f"{dim}D")
    _legend(figure, panels[0, 0], panels[0, 1])
    return figure


def _usual(rows, key):
    values = [row["case"][key] for row in rows]
    return max(sorted(set(values)), key=lambda value: len({str(r["case"]) for r in rows if r["case"][key] == value}))


def gradient(rows):
    figure = Figure(figsize=(10.5, 4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, dim in zip(panels, (2, 3), strict=True):
        of_dim = [row for row in rows if row["case"]["dim"] == dim and row["result"]["finite"]]
        _lines(axes, of_dim, "steps", "median_error")
        axes.set(xlabel="steps", title=f"{dim}D, 16 cells per axis")
    panels[0].set(ylabel="median relative error of the gradient")
    _legend(figure, *panels)
    return {"gradient": figure}


def design(rows):
    figure = Figure(figsize=(10.5, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for row in rows:
        colour, line, _ = STYLES[row["solver"]]
        label = solvers.FLOWS[row["solver"]].label
        left.plot(row["result"]["drags"], color=colour, ls=line, label=label)
        profile = row["result"]["profile"]
        right.plot(profile, (np.arange(len(profile)) + 0.5) / len(profile), color=colour, ls=line)
    left.set(xlabel="iteration", ylabel="mean drag")
    right.set(xlabel="velocity of the inflow", ylabel="y")
    _legend(figure, left)
    return {"design": figure}


def recovery(rows):
    figure = Figure(figsize=(7.5, 4), layout="constrained")
    axes = figure.subplots()
    for row in rows:
        colour, line, _ = STYLES[row["solver"]]
        losses = row["result"]["losses"]
        label = solvers.FLOWS[row["solver"]].label
        axes.plot(1 + np.arange(len(losses)), losses, color=colour, ls=line, label=label)
    axes.set(yscale="log", xlabel="iteration of L-BFGS", ylabel="mean squared misfit")
    _legend(figure, axes)
    return {"recovery": figure}


def conduction(rows):
    rows = [row for row in rows if row["case"]["what"] == "cost"]
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    panels = figure.subplots(1, 3)
    for axes, (part, name, scale) in zip(panels, PARTS, strict=True):
        _lines(axes, rows, "nx", part, scale)
        axes.set(xlabel="cells along x", ylabel=name.replace("rollout", "solve"))
    _legend(figure, *panels, family=solvers.CONDUCTION)
    return {"conduction": figure} if rows else {}


def _lines(axes, rows, along, value, scale=1.0):
    """A line per solver: a number of the result against one of the case."""
    for name, (colour, line, mark) in STYLES.items():
        points = sorted((row["case"][along], scale * row["result"][value]) for row in rows if row["solver"] == name)
        if points:
            axes.plot(*zip(*points, strict=True), color=colour, ls=line, marker=mark, ms=5, label=name)
    axes.set(xscale="log", yscale="log")
    ticks = sorted({row["case"][along] for row in rows})
    axes.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(alpha=0.3, lw=0.4)


def _legend(figure, *panels, family=solvers.FLOWS):
    """One entry per solver, whichever panel it is in."""
    handles = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(family[label].label if label in family else label, handle)
    if handles:
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=3, frameon=False)


DRAWN = {"cost": cost, "gradient": gradient, "design": design, "recovery": recovery, "conduction": conduction}
