"""How loose may the tolerance be that follows the error, and does a start from the state pay? Pairs of trainings with
the same seeds: forward and adjoint ratio of `ToleranceController`, with and without the start.

Products and errors are the same on a busy machine, so the trainings need no idle one, and seconds are left out."""

import numpy as np

from benchmarks.studies.evaluation import spread
from benchmarks.studies.trainings import saved
from prdp_torch.experiments.charts import make_figure

SEEDS = {
    "poisson_3p": 1, "poisson_3p_sd": 1, "heat_1d": 10, "diffusion_inverse": 10, "darcy_inverse": 8,
    "darcy_emulator": 8, "kolmogorov": 3, "burgers_1d": 2, "burgers_2d": 3, "heat_2d": 1,
}  # fmt: skip
BASE = ".1, .1, start"
WAYS = ("converged", BASE, ".1, .1", ".2, .2, start", ".2, .2")
LEFT_OUT = {
    "kolmogorov": (BASE, ".2, .2, start"),  # its solves are for changes, and start from zero
    **dict.fromkeys(("burgers_1d", "burgers_2d", "heat_2d"), (".1, .1",)),  # they take minutes
}


def run(study, seeds, quick):
    for name, most in list(SEEDS.items())[:1] if quick else SEEDS.items():
        for seed in range(min(seeds, most)):
            for how in WAYS:
                if how not in LEFT_OUT.get(name, ()):
                    study.train(name, how, seed, {})
                    study.rows[-1].pop("seconds", None)


def _of(rows, name, how):
    return [row for row in rows if row["scene"] == name and row["how"] == how]


def _base(rows, name):
    return _of(rows, name, BASE) or _of(rows, name, ".1, .1")


def _mean(rows, key):
    return np.mean([row[key] for row in rows])


def table(rows):
    lines = [
        "| scene | ratio, adjoint ratio | error | products | products / base | saved |",
        "|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(row["scene"] for row in rows):
        converged = _of(rows, name, "converged")
        base = _base(rows, name)
        title = f"{name}, {len(base)} seeds" if len(base) > 1 else name
        for how in WAYS:
            chosen = _of(rows, name, how)
            if chosen and len(chosen) == len(base):
                errors, products = spread([row["error"] for row in chosen]), _mean(chosen, "products")
                share = saved(chosen, converged, "products") if converged and how != "converged" else "–"
                of_base = products / _mean(base, "products")
                lines.append(f"| {title} | {how} | {errors} | {products:,.0f} | {of_base:.2f} | {share} |")
                title = ""
    return "\n".join(lines)


def chart(rows):
    """Error and products of each way, over those of BASE with the same seeds, one point a scene."""
    figure, (axes,) = make_figure(panels=1)
    for how, colour in zip(WAYS[2:], ("#222222", "#ff9f1c", "#1f77b4"), strict=True):
        points = []
        for name in dict.fromkeys(row["scene"] for row in rows):
            chosen, base = _of(rows, name, how), _base(rows, name)
            if chosen and len(chosen) == len(base):
                points.append([_mean(chosen, key) / _mean(base, key) for key in ("products", "error")])
        axes.scatter(*np.transpose(points), color=colour, label=how)
    axes.axhline(1, color="#888888", lw=0.6)
    axes.axvline(1, color="#888888", lw=0.6)
    axes.set(xlabel="products / those of .1, .1, start", ylabel="error / that of .1, .1, start")
    axes.grid(alpha=0.3, lw=0.4)
    axes.legend(frameon=False)
    return figure
