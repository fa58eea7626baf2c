"""Fields on 256² cells, where solves are all that an update costs: refinement on iterations of CG with multigrid,
beside CG, direct solves and multigrid that always converges."""

import numpy as np

from benchmarks.studies.evaluation import spread
from prdp_torch.experiments.charts import make_figure

SCENES = ("diffusion_inverse", "darcy_inverse")
SIDE, UPDATES = 256, 60
PLAIN = {"solver.max_iter": 2000}
CYCLES = {"solver.max_iter": 30, "solver.preconditioner": "multigrid", "prdp.initial": 1, "prdp.increment": 1}
# title: (refinement, changes of the scene)
WAYS = {
    "CG": ("converged", PLAIN | {"solver.preconditioner": "none"}),
    "Direct": ("direct", PLAIN | {"solver.preconditioner": "none"}),
    "CG with multigrid": ("converged", CYCLES),
    "PRDP, CG with multigrid": ("prdp", CYCLES),
    "auto, CG with multigrid": ("auto", CYCLES),
    "auto, CG": ("auto", PLAIN | {"solver.preconditioner": "none"}),
}


def run(study, seeds, quick):
    size = {
        "physics.shape": [12 if quick else SIDE] * 2,
        "training.updates": 3 if quick else UPDATES,
        "training.cosine_updates": UPDATES,
    }
    for scene in SCENES[1:] if quick else SCENES:
        for how, changes in WAYS.values():
            for seed in range(seeds):
                study.train(scene, how, seed, size | changes)


def _of(rows, scene, title):
    how, changes = WAYS[title]
    return [
        row for row in rows if row["scene"] == scene and row["how"] == how and changes.items() <= row["changes"].items()
    ]


def table(rows):
    lines = ["| scene | solver | error of the field | products | s |", "|---" * 5 + "|"]
    for scene in SCENES:
        for title in WAYS:
            chosen = _of(rows, scene, title)
            if not chosen:
                continue
            products, seconds = (np.mean([row[key] for row in chosen]) for key in ("products", "seconds"))
            error = spread([row["error"] for row in chosen])
            lines.append(f"| {scene} | {title} | {error} | {products:,.0f} | {seconds:,.0f} |")
    return "\n".join(lines)


def chart(rows):
    """The error of the field against seconds, a panel for each scene."""
    figure, panels = make_figure(panels=2)
    for axes, scene in zip(panels, SCENES, strict=True):
        for title, marker in zip(WAYS, "osD^vP", strict=True):
            chosen = _of(rows, scene, title)
            x, y = ([row[key] for row in chosen] for key in ("seconds", "error"))
            axes.plot(x, y, marker, ms=8, label=title, mfc="none", mew=2)
        axes.set(xscale="log", title=f"{scene}, {SIDE}²", xlabel="seconds, one core", ylabel="error of the field")
        axes.grid(alpha=0.3, lw=0.4)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure
