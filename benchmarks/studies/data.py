"""The data's share in the error: the draw of the samples, how many validate, and how many train.

All trainings have as many updates as the scene; more samples mean fewer epochs. With `data.fresh` no sample is seen
twice, and there are as many epochs as in the scene."""

import numpy as np

from benchmarks.studies.evaluation import spread
from prdp_torch.experiments.charts import make_figure

SCENES = ("heat_1d", "heat_2d", "burgers_1d")
UPDATES = {"heat_1d": 800, "heat_2d": 560, "burgers_1d": 800}
BATCH = 25
VALID = 100
WAYS = ("converged", "prdp", "auto")


def run(study, seeds, quick):
    names = SCENES[:1] if quick else SCENES
    for draw in range(seeds):
        for name in names:
            for how in ("converged", "prdp"):
                study.train(name, how, draw, {"data.valid": VALID, "data.seed": draw})
    for name in names:
        updates = UPDATES[name]
        for seed in range(min(seeds, 3)):
            for samples in (400,) if quick else (400, 1600, 6400):
                for how in ("converged",) if samples != 1600 else WAYS:
                    study.train(name, how, seed, changes_for(updates, samples))
            for how in () if quick else WAYS:
                study.train(name, how, seed, {"data.valid": VALID, "data.fresh": True})


def changes_for(updates, samples):
    epochs = max(1, round(updates * BATCH / samples))
    return {"data.valid": VALID, "data.train": samples, "training.epochs": epochs}


def table(rows):
    """Markdown: the draws, then the numbers of samples."""
    lines = ["| scene | | error on 5 | error on 100 | of the 100, mean over five |", "|---|---|---|---|---|"]
    for name in SCENES:
        for how in ("converged", "prdp"):
            draws = [np.array(r["errors"]) for r in _of(rows, name, how) if "data.seed" in r["changes"]]
            if not draws:
                continue
            fives = np.concatenate([d.reshape(-1, 5).mean(1) for d in draws])
            lines.append(
                f"| {name}, {len(draws)} draws | {how} | {spread([d[:5].mean() for d in draws])} "
                f"| {spread([d.mean() for d in draws])} | {fives.min():.2e} to {fives.max():.2e} |"
            )
    lines += ["", "| scene | samples | epochs | | training loss | error on 100 | products | s |"]
    lines.append("|---|---|---|---|---|---|---|---|")
    for name in SCENES:
        for samples, how in sorted({(_samples(r), r["how"]) for r in rows if r["scene"] == name}):
            chosen = [r for r in _of(rows, name, how) if _samples(r) == samples]
            loss, products, seconds = (np.mean([r[key] for r in chosen]) for key in ("loss", "products", "seconds"))
            fresh = " fresh" if "data.fresh" in chosen[0]["changes"] else ""
            lines.append(
                f"| {name} | {samples:,}{fresh} | {_epochs(chosen[0])} | {how} | {loss:.1e} "
                f"| {spread([r['error'] for r in chosen])} | {products:,.0f} | {seconds:.2g} |"
            )
    return "\n".join(lines)


def chart(rows):
    """Error on 100 validation samples against the number of training samples, at equal updates."""
    figure, (axes,) = make_figure()
    for name, colour in zip(SCENES, ("#0072B2", "#D55E00", "#009E73"), strict=True):
        for how, line, marker in (("converged", "-", "o"), ("prdp", "", "x"), ("auto", "", "+")):
            sizes = sorted({_samples(r) for r in _of(rows, name, how)})
            errors = [[r["error"] for r in _of(rows, name, how) if _samples(r) == size] for size in sizes]
            middle, deviation = [np.mean(e) for e in errors], [np.std(e) for e in errors]
            title = name if how == "converged" else None
            axes.errorbar(sizes, middle, deviation, color=colour, ls=line, marker=marker, capsize=3, label=title)
    axes.plot([], [], "kx", label="PRDP, tuned")
    axes.plot([], [], "k+", label="auto")
    axes.set(xscale="log", yscale="log", xlabel="training samples, at equal updates; the last ones are fresh")
    axes.set_ylabel("validation error on 100 samples,\nmean of (‖u − u_ref‖ / ‖u_ref‖)²")
    axes.grid(alpha=0.3, lw=0.4)
    axes.legend(frameon=False)
    return figure


def _of(rows, name, how):
    return [r for r in rows if r["scene"] == name and r["how"] == how]


def _samples(row):
    return BATCH * row["updates"] if "data.fresh" in row["changes"] else row["changes"].get("data.train", 200)


def _epochs(row):
    return row["updates"] // -(row["changes"].get("data.train", 200) // -BATCH)
