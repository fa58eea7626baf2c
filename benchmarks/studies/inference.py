"""How far must the solver go when a trained corrector is used? The error and the time of each K, for networks that
were trained with `prdp train navier_stokes`."""

import time
from pathlib import Path

import numpy as np
import torch

import prdp_torch as prdp
from prdp_torch import _C
from prdp_torch.experiments import records
from prdp_torch.experiments.charts import make_figure
from prdp_torch.experiments.network_task import error, propagator

KS = (1, 2, 5, 10, 15, 20, 44, 120)
STEPS = (5, 20, 50)


def run(study, seeds, quick):
    folder = Path("runs/navier_stokes-train")
    found = sorted(folder.glob("*/seed_*.pt"))
    if not found:
        raise SystemExit(f"inference: no trained network in {folder}; run 'prdp train navier_stokes' first")
    last = STEPS[0] if quick else STEPS[-1]
    for path in found:
        how, seed = path.parent.name, int(path.stem.split("_")[1])
        trained = prdp.load_trained(path.parent, seed)
        states = _C.validation_trajectories(trained.scene, last)
        for k in KS[:2] if quick else KS:
            row = {"how": how, "seed": seed, "k": k, **_follow(trained, states, k), **records.environment()}
            study.report(f"{how}, seed {seed}, K = {k}: {row['errors'][-1]:.3e} after {last} steps")
            study.rows.append(row)


def _follow(trained, states, k):
    trained.scene.data.valid_max_iter = k
    step = propagator(trained.scene, trained.network)
    u, errors = states[:, 0], [0.0]
    started = time.perf_counter()
    with torch.no_grad():
        for n in range(1, states.shape[1]):
            u = step(u)
            errors.append(error(trained.scene, u, states[:, n]))
    return {"errors": errors, "seconds_a_step": (time.perf_counter() - started) / (states.shape[1] - 1)}


def _of(rows, how, k):
    return [row for row in rows if row["how"] == how and row["k"] == k]


def table(rows):
    steps = [n for n in STEPS if n < len(rows[0]["errors"])]
    lines = [f"| trained with | K | {' | '.join(f'error after {n}' for n in steps)} | ms a step |"]
    lines.append("|---" * (len(steps) + 3) + "|")
    for how in sorted({row["how"] for row in rows}):
        for k in sorted({row["k"] for row in rows}):
            chosen = _of(rows, how, k)
            errors = " | ".join(f"{np.mean([row['errors'][n] for row in chosen]):.2e}" for n in steps)
            lines.append(f"| {how} | {k} | {errors} | {1e3 * np.mean([r['seconds_a_step'] for r in chosen]):.1f} |")
    return "\n".join(lines)


def chart(rows):
    figure, (axes,) = make_figure()
    steps = [n for n in STEPS if n < len(rows[0]["errors"])]
    ks = sorted({row["k"] for row in rows})
    for how, line in zip(sorted({row["how"] for row in rows}), ("-", "--", ":", "-."), strict=False):
        for n, colour in zip(steps, ("#009E73", "#0072B2", "#D55E00"), strict=False):
            errors = [np.mean([row["errors"][n] for row in _of(rows, how, k)]) for k in ks]
            axes.plot(ks, errors, color=colour, ls=line, marker="o", label=f"after {n} steps, trained with {how}")
    axes.set(xscale="log", yscale="log", xlabel="K of the corrector's solves, in use", ylabel="error of the x-velocity")
    axes.set_xticks(ks, ks)
    axes.grid(alpha=0.3, lw=0.4)
    axes.legend(frameon=False)
    axes.set_title("Navier–Stokes: how far the solver must go once the network is trained")
    return figure
