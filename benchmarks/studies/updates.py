"""Longer training of navier_stokes: the scene's updates and three times as many, at the same 200 samples.

The learning rate falls to a tenth over the whole training in both."""

import numpy as np

from benchmarks.studies.evaluation import seeds_of, spread
from prdp_torch.experiments.charts import make_figure

EPOCHS = (100, 300)
UPDATES_PER_EPOCH = 8
VALID = 20


def run(study, seeds, quick):
    for seed in range(seeds):
        for epochs in (1,) if quick else EPOCHS:
            study.train("navier_stokes", "converged", seed, changes_for(epochs), keep=("metric",))


def changes_for(epochs):
    cosine_updates = UPDATES_PER_EPOCH * epochs
    return {"data.valid": VALID, "training.epochs": epochs, "training.cosine_updates": cosine_updates}


def table(rows):
    lines = ["| updates | training loss | error on 5 | error on 20 | products | s |", "|---" * 6 + "|"]
    for updates in _updates(rows):
        chosen = _of(rows, updates)
        loss, products, seconds = (np.mean([row[key] for row in chosen]) for key in ("loss", "products", "seconds"))
        five, all_of_them = (spread([np.mean(row["errors"][:n]) for row in chosen]) for n in (5, VALID))
        lines.append(f"| {updates:,} | {loss:.1e} | {five} | {all_of_them} | {products:,.0f} | {seconds:,.0f} |")
    return "\n".join(lines)


def chart(rows):
    """The validation error over the training, one line for each seed."""
    figure, (axes,) = make_figure()
    for updates, colour in zip(_updates(rows), ("#0072B2", "#D55E00"), strict=False):
        for row in _of(rows, updates):
            title = f"{updates:,} updates" if row["seed"] == 0 else None
            done = np.linspace(0, updates, len(row["metric"]))  # from before the first update to after the last
            axes.plot(done, row["metric"], color=colour, lw=1, label=title)
    axes.set(yscale="log", ylim=(None, 0.1), xlabel="update", ylabel=f"validation error on {VALID} samples, at t = 5")
    axes.set_title(f"navier_stokes, three times as many updates ({seeds_of(rows)})")
    axes.grid(alpha=0.3, lw=0.4)
    axes.legend(frameon=False)
    return figure


def _updates(rows):
    return sorted({row["updates"] for row in rows})


def _of(rows, updates):
    return [row for row in rows if row["updates"] == updates]
