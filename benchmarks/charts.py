"""The pictures of the benchmarks, each a matplotlib figure with its caption."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

# One colour a method, whoever runs it; Okabe and Ito's, which colour-blind readers can tell apart.
COLOURS = {"Jacobi": "#0072B2", "Chebyshev": "#009E73", "steepest descent": "#CC79A7", "CG": "#E69F00",
           "GMRES": "#D55E00", "multigrid": "#56B4E9", "Multigrid": "#0072B2", "direct": "#222222", "LU": "#999999",
           "diagonal": "#009E73", "Function": "#CC79A7", "CSR": "#D55E00", "pyamg": "#CC79A7"}  # fmt: skip
MARKS = {
    "torch eager": "s",
    "torch.compile": "P",
    "JAX jit": "^",
    "lineax": "v",
    "SciPy": "D",
    "pyamg": "v",
    "Function": "X",
}


def colour(label):
    found = [name for name in COLOURS if name in label]
    return COLOURS[found[-1]] if found else "#666666"


def library(label):
    return next((name for name in MARKS if label.startswith(name)), None)


def _marker(label):
    """Solvers with growing K are small points on a line. All else is large and hollow, so that it hides nothing."""
    name = "Function" if "Function" in label else library(label)
    if name is None and label != "direct":
        return {"marker": "o", "ms": 4}
    return {"marker": MARKS.get(name, "o"), "ms": 9, "mfc": "none", "mew": 2, "zorder": 3}


def accuracy(title, points):
    """Rows: residual of the solution, error of the gradient. Columns: time, products with A."""
    figure = Figure(figsize=(11, 8.4), layout="constrained")
    panels = figure.subplots(2, 2, sharey="row")
    rows = (("residual", "forward", "relative residual"), ("gradient_error", "both", "relative error of the gradient"))
    for panel_row, (error, cost, name) in zip(panels, rows, strict=True):
        for axes, measure in zip(panel_row, ("seconds", "products"), strict=True):
            _curves(axes, points, error, cost, measure)
            axes.set(xscale="log", yscale="log")
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.grid(alpha=0.3, lw=0.4)
        work = "solve" if cost == "forward" else "solve and gradient"
        panel_row[0].set(ylabel=f"{name}, worst of the batch", xlabel=f"{work}, ms for the batch")
        panel_row[1].set(xlabel=f"{work}, products with A per sample")
    figure.suptitle(title)
    figure.legend(handles=_legend(points), loc="outside right upper", frameon=False)
    return figure


def _curves(axes, points, error, cost, measure):
    series = {}
    for p in points:
        if cost == "forward" and p["mode"] == "unrolled":
            continue  # the same solve as implicit
        x = 1e3 * p[f"{cost}_seconds"]["min"] if measure == "seconds" else p.get(f"{cost}_products")
        if x is not None:
            series.setdefault((p["label"], p["mode"]), []).append((x, max(p[error], 1e-16)))
    for (label, mode), values in series.items():
        x, y = zip(*values, strict=True)
        style = {"ls": "--", "mfc": "white"} if mode == "unrolled" else {"ls": "-"}
        axes.plot(x, y, color=colour(label), lw=1.4, **_marker(label) | style)


def _legend(points):
    handles = []
    for label in dict.fromkeys(p["label"] for p in points):
        marker = _marker(label)
        line = "-" if marker["ms"] < 9 else ""
        handles.append(Line2D([], [], color=colour(label), ls=line, label=label, **marker))
    if any(p["mode"] == "unrolled" for p in points):
        dashed = {"ls": "--", "marker": "o", "mfc": "white", "ms": 4}
        handles.append(Line2D([], [], color="#666666", label="dashed: unrolled", **dashed))
    return handles


def devices(records):
    """For each problem, the error over the time of a solve with its gradient, as K grows. The error is that of the
    gradient where it is known, else the residual."""
    titles = list(dict.fromkeys(r["problem"] for r in records))
    rows, columns = -(-len(titles) // 4), min(len(titles), 4)
    figure = Figure(figsize=(3.7 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).flat
    for axes, title in zip(panels, titles, strict=False):
        of_problem = [r for r in records if r["problem"] == title]
        for way in dict.fromkeys(r["way"] for r in of_problem):
            line = sorted((r for r in of_problem if r["way"] == way), key=lambda r: r["k"])
            error = [max(r.get("gradient_error", r["residual"]), 1e-16) for r in line]
            style = {"marker": "s"} if "eager" in way else {"marker": "^"} if "JAX" in way else {"marker": "o"}
            axes.plot([1e3 * r["seconds"] for r in line], error, lw=1.4, ms=5, label=way, **style)
        known = "gradient_error" in of_problem[0]
        axes.set(xscale="log", yscale="log", title=title, xlabel="solve and gradient, ms for the batch")
        axes.set(ylabel="error of the gradient" if known else "residual")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3, lw=0.4)
        axes.legend(frameon=False, fontsize=8)
    for axes in list(panels):
        axes.set_visible(False)
    return figure


def size(series):
    """Time per unknown and iteration over the size of a sample, and over the batch."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    marks = dict(zip(series["size"], "osD^", strict=True))
    shades = dict(zip(series["size"], ("#0072B2", "#009E73", "#E69F00", "#D55E00"), strict=True))
    for axes, which, along in ((left, "size", "unknowns"), (right, "batch", "batch")):
        for name, points in series[which].items():
            x, y = zip(*((p[along], 1e9 * p["per_unknown"]) for p in points), strict=True)
            axes.plot(x, y, marker=marks[name], color=shades[name], ms=4, lw=1.4, label=name)
        axes.set(xscale="log", yscale="log")
        axes.grid(alpha=0.3, which="both", lw=0.4)
    for name, held in series["caches"].items():  # three vectors of float32 fill the cache
        left.axvline(held / 12, color="#999999", lw=0.8, ls=":")
        left.text(held / 13, 0.98, name, transform=left.get_xaxis_transform(), ha="right", va="top", color="#666666")
    left.set(xlabel="unknowns of one sample (batch 1)", ylabel="ns per unknown and product with A")
    right.set(xlabel="samples in the batch")
    right.legend(frameon=False, fontsize=9)
    return figure


def large(points):
    """Seconds, with the setup and of one more solve, and the true residual, over the unknowns of one sample."""
    figure = Figure(figsize=(11.5, 4.8), layout="constrained")
    panels = figure.subplots(1, 3)
    points = [p for p in points if p.get("grid", "²").endswith("²") and not p["solver"].endswith(("threads", "κ"))]
    for label in dict.fromkeys(p["solver"] for p in points):
        line = [p for p in points if p["solver"] == label]
        mark = MARKS.get(library(label), "o")
        style = {"color": colour(label), "marker": mark, "lw": 1.4, "ms": 5, "label": label}
        if "aggregation" in label:
            style["ls"] = "--"
        for axes, what in zip(panels, ("seconds", "again", "residual"), strict=True):
            if what == "residual" and line[0][what] < 1e-9:  # of an exact solver in float64, far below all others
                axes.set(xlabel=f"unknowns of one sample\n{label}: at most {max(p[what] for p in line):.1e}")
                continue
            axes.plot([p["unknowns"] for p in line], [p[what] for p in line], **style)
    titles = ("first solve, with its setup: seconds", "one more with the same κ: seconds", "‖b - A u‖ / ‖b‖ in float64")
    for axes, title in zip(panels, titles, strict=True):
        axes.set(xscale="log", yscale="log", xlabel=axes.get_xlabel() or "unknowns of one sample", title=title)
        axes.grid(alpha=0.3, which="both", lw=0.4)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9
    )
    return figure


def roofline(found):
    """Arithmetic against arithmetic intensity, under the limits measured in the same run."""
    limits = found["limits"]
    figure = Figure(figsize=(9.2, 5), layout="constrained")
    axes = figure.subplots()
    intensity = np.geomspace(0.05, 10, 50)
    for (level, bandwidth), line in zip(limits["gb_per_s"].items(), ("-", "--", "-.", ":"), strict=True):
        axes.plot(intensity, np.minimum(limits["gflops"], bandwidth * intensity), color="#999999", ls=line, lw=1.2,
                  label=f"{level}: {bandwidth:.0f} GB/s")  # fmt: skip
    axes.axhline(limits["gflops"], color="#222222", lw=1, label=f"arithmetic: {limits['gflops']:.0f} GFLOP/s")
    marks = dict(zip(dict.fromkeys(p["problem"] for p in found["points"]), "osD^vP", strict=False))
    for p in found["points"]:
        axes.plot(p["gflops"] / p["gb_per_s"], p["gflops"], marks[p["problem"]], color=colour(p["label"]), ms=8,
                  mec="white", label=f"{p['problem']}: {p['label']}")  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="operations per byte of vectors read or written", ylabel="GFLOP/s")
    axes.grid(alpha=0.3, which="both", lw=0.4)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False, fontsize=9)
    return figure


def change_of_k(found):
    """Bars: the first call with a new K, and a later one."""
    names = list(dict.fromkeys((p["problem"], p["label"]) for p in found))
    figure = Figure(figsize=(9.2, 1.2 + 0.42 * len(names)), layout="constrained")
    axes = figure.subplots()
    for at, name in enumerate(reversed(names)):
        points = [p for p in found if (p["problem"], p["label"]) == name][1:]  # the first K of all warms up
        first, later = (1e3 * float(np.median([p[key] for p in points])) for key in ("first_seconds", "later_seconds"))
        axes.barh(at, first, color="#D55E00", height=0.7)
        axes.barh(at, later, color="#0072B2", height=0.7)
        axes.text(first, at, f" {first:,.0f} ms" if first > 10 else f" {first:.2g} ms", va="center", fontsize=9)
    axes.set_yticks(range(len(names)), [f"{problem}: {label}" for problem, label in reversed(names)])
    axes.set(xscale="log", xlabel="ms, solve and gradient of a batch of 25 (median over five changes)")
    axes.margins(x=0.15)
    axes.spines[["top", "right"]].set_visible(False)
    handles = [Line2D([], [], color=c, lw=8, label=text)
               for c, text in (("#D55E00", "first call with a new K"), ("#0072B2", "the next call"))]  # fmt: skip
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    return figure


def training(found):
    """An update in parts: the network with its optimiser, and the physics."""
    names = [f"{p['scene']}, K = {p['k']}" for p in found]
    figure = Figure(figsize=(9.2, 1.6 + 0.36 * len(found)), layout="constrained")
    axes = figure.subplots()
    for at, p in enumerate(reversed(found)):
        share = 100 * (1 - p["network_seconds"] / p["update_seconds"])
        axes.barh(at, 100 - max(0, share), color="#bbbbbb", height=0.7)
        axes.barh(at, max(0, share), left=100 - max(0, share), color="#D55E00", height=0.7)
        physics = f"{share:.0f} %" if share >= 5 else "below 5 %"
        whole = f"{1e3 * p['update_seconds']:.3g} ms" if p["update_seconds"] < 1 else f"{p['update_seconds']:.2f} s"
        axes.text(101, at, f"{physics} of {whole}", va="center", fontsize=9)
    axes.set_yticks(range(len(found)), list(reversed(names)))
    axes.set(xlabel="% of an update", xlim=(0, 125), xticks=range(0, 101, 20))
    axes.spines[["top", "right"]].set_visible(False)
    parts = (("#bbbbbb", "network and optimiser"), ("#D55E00", "physics, with its derivative"))
    handles = [Line2D([], [], color=shade, lw=8, label=text) for shade, text in parts]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    return figure


def memory(found, titles):
    """Peak memory against K, one panel a problem."""
    figure = Figure(figsize=(11.5, 3.8), layout="constrained")
    colours = ("#0072B2", "#D55E00", "#009E73", "#999999")
    for axes, case in zip(figure.subplots(1, len(titles)), titles, strict=True):
        modes = dict.fromkeys(p["mode"] for p in found)
        for mode, colour in zip(modes, colours, strict=False):
            points = [p for p in found if (p["case"], p["mode"]) == (case, mode)]
            axes.plot([p["k"] for p in points], [p["bytes"] / 1e6 for p in points], "o-", color=colour, label=mode)
        axes.set(xscale="log", yscale="symlog", ylim=(0, None), xlabel="K", ylabel="MB at the peak", title=titles[case])
        axes.set_xticks([p["k"] for p in points], [str(p["k"]) for p in points])
        axes.minorticks_off()
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure
