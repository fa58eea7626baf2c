"""The data's share in the error: the draw of the samples, how many validate, and how many train.

All trainings have as many updates as the scene; more samples mean fewer epochs. "fresh" means that no sample is
seen twice."""

import numpy as np

from benchmarks.studies.evaluation import spread
from prdp_torch.experiments.charts import make_figure

SCENES = ("heat_1d", "heat_2d", "burgers_1d")
UPDATES = {"heat_1d": 800, "heat_2d": 560, "burgers_1d": 800}
BATCH = 25
VALID = 100


def run(study, seeds, quick):
    names = SCENES[:1] if quick else SCENES
    for draw in range(seeds):
        for name in names:
            for how in ("converged", "prdp"):
                study.train(name, how, draw, {"data.valid": VALID, "data.seed": draw})
    for name in names:
        updates = UPDATES[name]
        for samples in (400, 1600, 6400, updates * BATCH):
            if quick and samples > 400:
                continue
            for seed in range(min(seeds, 3)):
                for how in ("converged",) if samples != 1600 else ("converged", "prdp", "auto"):
                    study.train(name, how, seed, changes_for(updates, samples))


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
    lines += ["", "| scene | samples | epochs | | training loss | error on 100 |", "|---|---|---|---|---|---|"]
    for name in SCENES:
        for samples, how in sorted({(_samples(r), r["how"]) for r in rows if r["scene"] == name}):
            chosen = [r for r in _of(rows, name, how) if _samples(r) == samples]
            lines.append(
                f"| {name} | {samples:,} | {chosen[0]['updates'] * BATCH // samples} | {how} "
                f"| {np.mean([r['loss'] for r in chosen]):.1e} | {spread([r['error'] for r in chosen])} |"
            )
    return "\n".join(lines)


def chart(rows):
    """Error on 100 validation samples against the number of training samples, at equal updates."""
    figure, (axes,) = make_figure()
    for name, colour in zip(SCENES, ("#0072B2", "#D55E00", "#009E73"), strict=True):
        sizes = sorted({_samples(r) for r in _of(rows, name, "converged")})
        if not sizes:
            continue
        errors = [[r["error"] for r in _of(rows, name, "converged") if _samples(r) == size] for size in sizes]
        middle = [np.mean(e) for e in errors]
        axes.errorbar(sizes, middle, [np.std(e) for e in errors], color=colour, marker="o", capsize=3, label=name)
    axes.set(xscale="log", yscale="log", xlabel="training samples, at equal updates")
    axes.set_ylabel("validation error on 100 samples,\nmean of (‖u − u_ref‖ / ‖u_ref‖)²")
    axes.grid(alpha=0.3, lw=0.4)
    axes.legend(frameon=False)
    axes.set_title("More samples are the cheapest accuracy")
    return figure


def _of(rows, name, how):
    return [r for r in rows if r["scene"] == name and r["how"] == how]


def _samples(row):
    return row["changes"].get("data.train", 200)
