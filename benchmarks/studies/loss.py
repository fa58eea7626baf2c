"""PRDP driven by the training loss in place of the validation metric, for who has no validation data (paper,
appendix)."""

import numpy as np
from matplotlib.ticker import MaxNLocator

from benchmarks.studies.evaluation import spread
from benchmarks.studies.trainings import saved
from prdp_torch.experiments.charts import make_figure

SEEDS = {"heat_1d": 10, "burgers_1d": 3}
WAYS = {"converged": "converged", "prdp": "PRDP on validation", "prdp_loss": "PRDP on the training loss"}


def run(study, seeds, quick):
    for name, most in SEEDS.items():
        for how in WAYS:
            for seed in range(1 if quick else min(seeds, most)):
                if name == "heat_1d" or not quick:
                    study.train(name, how, seed, {})


def _of(rows, name, how):
    return [row for row in rows if row["scene"] == name and row["how"] == how]


def table(rows):
    lines = ["| scene | | error | training loss | last K | iterations saved | warns |", "|---|---|---|---|---|---|---|"]
    for name in SEEDS:
        for how, title in WAYS.items():
            chosen = _of(rows, name, how)
            if chosen:
                share = "–" if how == "converged" else saved(chosen, _of(rows, name, "converged"), "budget")
                loss, last = (np.mean([row[key] for row in chosen]) for key in ("loss", "last_k"))
                warns = sum(row["warning"] is not None for row in chosen)
                errors = spread([row["error"] for row in chosen])
                lines.append(
                    f"| {name}, {len(chosen)} seeds | {title} | {errors} | {loss:.1e} | {last:.3g} | {share} "
                    f"| {f'{warns} of {len(chosen)}' if warns else '–'} |"
                )
    return "\n".join(lines)


def chart(rows):
    figure, panels = make_figure(panels=2)
    for axes, name in zip(panels, SEEDS, strict=True):
        for (how, title), colour in zip(WAYS.items(), ("#222222", "#d62728", "#ff9f1c"), strict=True):
            chosen = _of(rows, name, how)
            axes.scatter([r["budget"] for r in chosen], [r["error"] for r in chosen], color=colour, label=title)
        axes.set(xlabel="iterations, K summed over the solves", ylabel="validation error", title=name)
        axes.set(xlim=(0, None), ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.grid(alpha=0.3, lw=0.4)
    panels[0].legend(frameon=False)
    return figure
