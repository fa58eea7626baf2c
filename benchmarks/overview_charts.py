"""Two pictures that are read at a glance: the error of each way of solving, and what each scene needs."""

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.refinement_charts import CONSTANT, ROWS, seeds_of
from docs.record_rows import by_label, claims, power

WITHIN, BEYOND = "#8fb8de", "#e3a48f"  # as good as converged; not so
COLOURS = {"auto": ROWS["auto"][1], "prdp": ROWS["prdp"][1], "rtol": CONSTANT}


def errors(found, highest=2.2):
    """Of a comparison: a bar per row with the spread of the seeds, and its products. A bar ends at `highest` times the
    converged error, and then has its error beside it."""
    rows, base = found["rows"], found["rows"][0]
    figure = Figure(figsize=(8.0, 0.9 + 0.32 * len(rows)), layout="constrained")
    axes = figure.subplots()
    limit = highest * base["metric"]
    for at, row in enumerate(rows):
        error = min(row["metric"], limit)
        axes.barh(at, error, height=0.7, color=WITHIN if claims(row) or row is base else BEYOND)
        if row["metric"] < limit:
            axes.errorbar(error, at, xerr=row["metric_std"], color="#333333", lw=1, capsize=2)
        else:
            axes.text(limit, at, f"{row['metric']:.2g} ", ha="right", va="center", fontsize=9)
    axes.axvline(base["metric"], color="#222222", lw=1, ls="--")
    axes.set_yticks(range(len(rows)), [row["title"] for row in rows])
    axes.set(
        xlim=(0, limit), ylim=(len(rows) - 0.4, -0.6), xlabel="validation error; dashed: converged; red: fails or warns"
    )
    right = axes.secondary_yaxis("right")
    right.set_yticks(range(len(rows)), [f"{row['operator_applications']:,.0f}" for row in rows])
    right.tick_params(length=0)
    axes.set_title("products with A", loc="right", fontsize=10)
    for spine in (axes.spines["top"], axes.spines["right"], right.spines["right"]):
        spine.set_visible(False)
    return figure


SHOWN = (("auto", "D", "auto", -0.2), ("prdp", "o", "PRDP, tuned", 0.0), ("rtol", "s", "best constant rtol", 0.2))


def products(found):
    """Of each scene: the products of auto, of tuned PRDP and of the best constant, as shares of the converged ones."""
    figure = Figure(figsize=(8.0, 1.2 + 0.48 * len(found)), layout="constrained")
    axes = figure.subplots()
    for at, summary in enumerate(found.values()):
        rows = by_label(summary)
        rows["rtol"] = _best_constant(rows)
        axes.axhline(at + 0.5, color="#e4e4e4", lw=0.8, zorder=0)
        for label, marker, _, shift in SHOWN:
            if row := rows.get(label):
                share = row["operator_applications"] / rows["converged"]["operator_applications"]
                _mark(axes, (share, at + shift), marker, COLOURS[label], claims(row))
                if label == "rtol":
                    text = power(float(row["label"].rpartition("_")[2]))
                    axes.text(1.05 * share, at + shift, text, va="center", fontsize=8, color=CONSTANT)
    axes.set_yticks(range(len(found)), [f"{name} ({seeds_of(summary['rows'])})" for name, summary in found.items()])
    axes.axvline(1, color="#222222", lw=1, ls="--")
    axes.set(xscale="log", xlabel="products with A; converged = 1 (dashed)", ylim=(len(found) - 0.4, -0.6))
    ticks = (0.1, 0.2, 0.5, 1)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlim(0.07, 1.2)
    axes.spines[["top", "right", "left"]].set_visible(False)
    style = {"ls": "", "color": "#444444"}
    handles = [
        Line2D([], [], **{**style, "color": COLOURS[label]}, marker=marker, label=title)
        for label, marker, title, _ in SHOWN
    ]
    handles.append(Line2D([], [], **style, marker="o", mfc="none", label="hollow: fails or warns"))
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    return figure


def _best_constant(rows):
    """The constant tolerance with the fewest products, of those that neither fail nor warn."""
    constants = [row for label, row in rows.items() if label.startswith("rtol_") and claims(row)]
    return min(constants, key=lambda row: row["operator_applications"], default=None)


def _mark(axes, place, marker, colour, is_claimed):
    axes.scatter(*place, marker=marker, s=42, facecolors=colour if is_claimed else "white", edgecolors=colour, zorder=2)
