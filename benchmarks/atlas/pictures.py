"""The pictures of the atlas: each has a question for its title and the measured answer below it."""

import math

import numpy as np
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap
from matplotlib.ticker import FixedFormatter, FixedLocator, NullFormatter, NullLocator

from prdp_torch.experiments.charts import make_figure

# One colour per method in all pictures; Okabe and Ito's, which colour-blind readers can tell apart.
COLOURS = {"GMRES(2)": "#56B4E9", "BiCGStab": "#8C6D31",
           "Jacobi": "#0072B2", "Chebyshev": "#009E73", "SteepestDescent": "#CC79A7", "CG": "#E69F00",
           "GMRES": "#D55E00", "Multigrid": "#5B2C8A", "Direct": "#222222", "constant K": "#0072B2",
           "implicit": "#0072B2", "unrolled": "#D55E00",
           "solution": "#888888", "primal": "#0072B2", "adjoint": "#D55E00"}  # fmt: skip
STATUSES = {"CONVERGED": "#4daf7c", "CONVERGED_BREAKDOWN": "#8fd0ad", "MAX_ITER": "#f2e6a2", "STAGNATED": "#e8c468",
            "DIVERGED": "#d7301f", "OVERFLOW": "#a50f15", "BREAKDOWN": "#f08a5d", "ZERO_DIAGONAL": "#9e9ac8",
            "INCONSISTENT": "#807dba", "NONFINITE_INPUT": "#54278f", "NONFINITE_OPERATOR": "#3f007d"}  # fmt: skip

SHARES = LinearSegmentedColormap.from_list("shares", ["#e8644a", "#f6e3a1", "#6cc294"])


def titled(question, answer, panels=1, height=4.4):
    figure, axes = make_figure(panels, height)
    figure.suptitle(f"{question}\n", fontsize=13, fontweight="bold")
    inch = 1 / figure.get_figheight()
    figure.text(0.5, 1 - 0.4 * inch, answer, ha="center", va="center", fontsize=10.5, color="#333333")
    return figure, axes


def _style(name):
    method = next((m for m in COLOURS if name.startswith(m)), None)
    dashed = any(word in name for word in ("diagonal", "unrolled", "float64"))
    return {"color": COLOURS.get(method, "#666666"), "ls": ":" if "multigrid" in name else "--" if dashed else "-"}


def _draw_lines(axes, x, lines, floor=1e-16):
    for name, values in lines.items():
        known = [math.nan if v is None else max(v, floor) for v in values]
        axes.plot(x, known, marker="o", ms=4, lw=1.8, label=name, **_style(name))
    axes.set(xscale="log", yscale="log")
    axes.grid(alpha=0.3, lw=0.5)


def _mark(axes, at, text, vertical=True, height=0.04):
    if vertical:
        axes.axvline(at, color="#444444", lw=1.2, ls=":")
        axes.text(at, height, f" {text}", transform=axes.get_xaxis_transform(), fontsize=9, color="#444444")
    else:
        axes.axhline(at, color="#444444", lw=1.2, ls=":")
        axes.text(0.01, at, text, transform=axes.get_yaxis_transform(), fontsize=9, color="#444444", va="bottom")


def cost(xlabel, boundary=None):
    """Products with A over x; a line ends where some samples are not solved."""

    def draw(question, data):
        figure, (axes,) = titled(question, data["answer"])
        _draw_lines(axes, data["x"], data["lines"])
        for name, values in data["lines"].items():
            last = values.index(None) - 1 if None in values else -1
            if last >= 0:
                axes.plot(data["x"][last], values[last], "X", ms=11, color=_style(name)["color"], mec="white", zorder=4)
        axes.set(xlabel=xlabel, ylabel="products with A until 1e-5\n(median; × where the solves begin to fail)")
        if boundary is not None:
            at, text = boundary(data) if callable(boundary) else boundary
            if at is not None:
                _mark(axes, at, text)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", frameon=False)
        return figure

    return draw


def grid_size(question, data):
    figure = cost("N, points along each axis of the unit square")(question, data)
    (axes,) = figure.axes
    _plain_ticks(axes, data["x"])
    return figure


def _plain_ticks(axes, x):
    axes.xaxis.set_major_locator(FixedLocator(x))
    axes.xaxis.set_major_formatter(FixedFormatter([f"{v:g}" for v in x]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())


def floor(question, data):
    figure, (axes,) = titled(question, data["answer"])
    _draw_lines(axes, data["x"], data["lines"])
    _mark(axes, 1e-5, "1e-5", vertical=False)
    for name, n in data["first"].items():
        if n is not None:
            _mark(axes, n, f"{name}: N = {n}", height=0.95 if name == "CG" else 0.88)
    axes.set(xlabel="N, points of Poisson in 1D", ylabel="residual that is reached\n(worst sample; 1e-7 was asked for)")
    _plain_ticks(axes, data["x"])
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure


def shares(xlabel, ylabel):
    """A table of the share of samples that were solved: the products where all were, the status where none was."""

    def draw(question, data):
        rows = data["rows"]
        figure, (axes,) = titled(question, data["answer"], height=2.0 + 0.36 * len(rows))
        share = np.array(data["share"])
        image = axes.imshow(share, cmap=SHARES, vmin=0, vmax=1, aspect="auto")
        for i, j in np.ndindex(share.shape):
            products, status = data["products"][i][j], data["status"][i][j].replace("_", "\n")
            text = f"{products:,.0f}" if products is not None else f"{share[i, j]:.0%}" if share[i, j] > 0 else status
            size = 9 if share[i, j] > 0 else 6.5
            axes.text(j, i, text, ha="center", va="center", fontsize=size, color="black", linespacing=0.9)
        axes.set_xticks(range(len(data["x"])), [f"{x:g}" for x in data["x"]])
        axes.set_yticks(range(len(rows)), rows)
        axes.set(xlabel=xlabel, ylabel=ylabel)
        label = "share of samples solved to 1e-5\n(numbers: products with A, the median)"
        figure.colorbar(image, ax=axes, label=label, format=lambda v, _: f"{v:.0%}")
        return figure

    return draw


def statuses(question, data):
    rows, columns = data["rows"], data["x"]
    figure, (axes,) = titled(question, data["answer"], height=2.0 + 0.42 * len(rows))
    names = list(STATUSES)
    numbers = np.array([[names.index(s) for s in row] for row in data["status"]])
    colours = ListedColormap(list(STATUSES.values()))
    axes.imshow(numbers, cmap=colours, norm=BoundaryNorm(np.arange(len(names) + 1) - 0.5, len(names)), aspect="auto")
    for i, j in np.ndindex(numbers.shape):
        axes.text(j, i, data["status"][i][j].replace("_", "\n"), ha="center", va="center", fontsize=7, linespacing=0.9)
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xticks(np.arange(len(columns)) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(rows)) - 0.5, minor=True)
    axes.grid(which="minor", color="white", lw=1.5)
    axes.tick_params(which="both", length=0)
    return figure


def primal_adjoint(question, data):
    figure, (left, right) = titled(question, data["answer"], panels=2, height=4.6)
    _draw_lines(left, data["x"], data["lines"])
    _mark(left, 1e-5, "1e-5", vertical=False)
    left.set(xlabel="K, iterations allowed", ylabel="relative residual", ylim=(1e-17, 3))
    left.set_title("steepest descent on Poisson, b an eigenvector", fontsize=10)
    left.legend(frameon=False, loc="center right")
    names = list(data["outcomes"])
    shares = np.array([data["outcomes"][name] for name in names])
    beside = np.zeros(len(names))
    kinds = (("both", "#4daf7c"), ("primal alone", "#0072B2"), ("adjoint alone", "#D55E00"), ("neither", "#bbbbbb"))
    for k, (kind, colour) in enumerate(kinds):
        bars = right.barh(range(len(names)), 100 * shares[:, k], left=100 * beside, color=colour, label=kind)
        right.bar_label(
            bars, [f"{100 * s:.0f}" if s > 0.04 else "" for s in shares[:, k]], label_type="center", fontsize=9
        )
        beside += shares[:, k]
    right.set_yticks(range(len(names)), names)
    right.set(xlabel="% of random Burgers operators, CFL 100, 300 products", ylim=(len(names) - 0.4, -1.5))
    right.set_title("which of the two converges", fontsize=10)
    right.legend(frameon=False, ncols=4, loc="upper center", fontsize=8.5, columnspacing=1, handlelength=1)
    return figure


def modes(question, data):
    figure, panels = titled(question, data["answer"], panels=len(data["panels"]), height=4.2)
    for axes, (name, panel) in zip(panels, data["panels"].items(), strict=True):
        for line, values in panel["lines"].items():
            style = {"implicit": "-", "unrolled": "--", "solution": ":"}[line]
            axes.plot(
                panel["x"],
                np.maximum(values, 1e-16),
                style,
                color=COLOURS[line],
                marker="o",
                ms=3.5,
                lw=1.8,
                label=line,
            )
        axes.set(xscale="log", yscale="log", xlabel="K, iterations", ylim=(1e-16, 30))
        axes.set_title(name, fontsize=10)
        axes.grid(alpha=0.3, lw=0.5)
        if axes is not panels[0]:
            axes.tick_params(labelleft=False)
    panels[0].set_ylabel("relative error of the gradient\n(dotted: of the solution)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def single(question, data):
    figure, panels = titled(question, data["answer"], panels=len(data["panels"]))
    for axes, (name, lines) in zip(panels, data["panels"].items(), strict=True):
        for line, values in lines.items():
            axes.plot(data["x"], np.maximum(values, 1e-16), marker="o", ms=4, lw=1.8, label=line, **_style(line))
        axes.set(xscale="log", yscale="log", xlabel="CFL number of a Burgers step (N = 64)", ylim=(1e-9, 1e3))
        axes.set_title(name, fontsize=10)
        _mark(axes, 1e-5, "rtol = 1e-5", vertical=False)
        axes.grid(alpha=0.3, lw=0.5)
    panels[0].set_ylabel("relative error of the gradient\n(worst sample)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure


def few(question, data):
    figure, (axes,) = titled(question, data["answer"])
    _draw_lines(axes, data["x"], data["lines"])
    axes.axhline(data["auto"], color="#D55E00", lw=1.8, ls="--", label="auto (ToleranceController)")
    _mark(axes, data["fewest"], f"K = {data['fewest']}", height=0.9)
    axes.set(xlabel="K, Jacobi iterations of every solve", ylabel="validation error of heat_1d\nafter the training")
    _plain_ticks(axes, data["x"])
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure
