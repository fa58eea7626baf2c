"""The network in bfloat16: the Navier–Stokes corrector trained under autocast, beside float32. The solves stay in
float32."""

import numpy as np
import torch

from benchmarks.studies import evaluation
from benchmarks.studies.trainings import variant
from prdp_torch.experiments import records
from prdp_torch.experiments.charts import make_figure
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train


class InBfloat16(torch.nn.Module):
    """The network, its products in bfloat16; state and gradients in float32."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, u):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return self.network(u).to(u.dtype)


def run(study, seeds, quick):
    for seed in range(min(seeds, 3)):
        for precision in ("float32", "bfloat16"):
            path = study.folder / f"{precision}_seed{seed}.json"
            row = records.read(path)
            if row is None or row["quick"] != quick:
                row = {"precision": precision, "seed": seed, "quick": quick, **_trained(precision, seed, quick)}
                records.write_training(path, {**row, **records.environment()})
            study.report(f"{precision}, seed {seed}: {row['error']:.3e} in {row['seconds']:.0f} s")
            study.rows.append(row)


def _trained(precision, seed, quick):
    small = {"data.train": 25, "data.valid": 1, "training.epochs": 1}
    scene = variant("navier_stokes", small if quick else {"data.valid": 20})
    network = make_network(scene, seed)
    used = InBfloat16(network) if precision == "bfloat16" else network
    curves = train(scene, Refinement.auto(), seed=seed, network=used)
    errors = evaluation.validation_errors(scene, used)
    return {
        "error": float(np.mean(errors)), "errors": errors, "metric": curves["metric"],
        "seconds": sum(curves["seconds"]), "products": sum(curves["operator_applications"]),
    }  # fmt: skip


def table(rows):
    lines = ["| network | error at t = 5, 20 samples | products with A | s |", "|---|---|---|---|"]
    for precision in ("float32", "bfloat16"):
        chosen = [row for row in rows if row["precision"] == precision]
        error, products, seconds = (np.mean([row[key] for row in chosen]) for key in ("error", "products", "seconds"))
        seeds = f", {len(chosen)} seeds" if len(chosen) > 1 else ""
        lines.append(f"| {precision}{seeds} | {error:.2e} | {products:,.0f} | {seconds:.0f} |")
    return "\n".join(lines)


def chart(rows):
    figure, (axes,) = make_figure()
    for row in rows:
        colour = "#222222" if row["precision"] == "float32" else "#d62728"
        axes.plot(row["metric"], color=colour, label=row["precision"] if row["seed"] == 0 else None)
    axes.set(yscale="log", xlabel="epoch", ylabel="error at t = 5")
    axes.grid(alpha=0.3, lw=0.4)
    axes.legend(frameon=False)
    axes.set_title(f"Navier–Stokes corrector: the network in bfloat16 and float32 ({evaluation.seeds_of(rows)})")
    return figure
