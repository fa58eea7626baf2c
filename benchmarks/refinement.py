"""The parts of auto one by one, beside PRDP and converged solves: `python -m benchmarks.refinement SCENE`.

Writes a record for each training and a summary, as `prdp compare` does, and prints its rows. The summaries kept in
docs/results are what docs/result_tables.py and `python -m benchmarks.refinement_charts` read. With --resume, finished
trainings are kept. With --rows, the summary also holds the trainings that other rows have.
"""

import argparse
from pathlib import Path

import torch

from prdp_torch.controller import PRDPController, ToleranceController
from prdp_torch.experiments import compare, records, scenes
from prdp_torch.experiments.compare import Row
from prdp_torch.experiments.refinement import Refinement


def rows_of(scene):
    converged = scene.max_iter
    rows = [
        Row("converged", f"converged, K = {converged}", "converged", Refinement.constant(converged), converged),
        Row("prdp", "PRDP, tuned", "prdp", Refinement.prdp(scene)),
        Row("prdp_defaults", "PRDP, defaults", "prdp", Refinement("prdp_defaults", PRDPController)),
        _tolerance("tolerance", "tolerance", adjoint_ratio=1.0, adjoint_floor=1e-5),
        _tolerance("tolerance_adjoint", "tolerance, adjoint looser"),
        Row("auto", "auto: with the start as well", "auto", Refinement.auto()),
    ]
    if scene.task == "corrector":
        rows.append(
            Row("none", f"K = {converged}, backward none", "constant", Refinement.constant(converged), converged)
        )
    return rows


def _tolerance(label, title, **settings):
    refinement = Refinement(label, lambda steppers: ToleranceController(steppers, **settings), watches_error=True)
    return Row(label, title, "auto", refinement)


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.refinement")
    parser.add_argument("scene")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rows", nargs="*", help="labels of the rows to train; all where none is given")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--resume", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    scene = scenes.load(options.scene)
    folder = records.prepare_folder(options.out or Path("runs") / f"{scene.name}-refinement")
    environment = records.environment()
    rows = []
    for row in rows_of(scene):
        train(row, options, folder, environment)
        if not row.curves:
            continue
        rows.append(row)
        table = compare.summarise(scene, rows)
        print(f"{row.title}: {table[-1]['metric']:.2e}, {table[-1]['operator_applications']:,.0f} products", flush=True)
    trained = [records.read(path) for row in rows for path in sorted((folder / row.label).glob("seed_*.json"))]
    environment["commit"] = ", ".join(dict.fromkeys(record["commit"] for record in trained))  # some were resumed
    environment["machine"] = trained[0]["machine"]
    summary = {"settings": records.settings(scene), **environment}
    curves = {row.label: _curves(row) for row in rows}
    records.write(folder / "summary.json", {**summary, "seeds": options.seeds, "rows": table, "curves": curves})


def train(row, options, folder, environment):
    """Fill in the curves of a row: one of each seed, or those that are there where the row is not asked for."""
    scene = scenes.load(options.scene)
    if row.label == "none":
        scene.backward = "none"
    asked = not options.rows or row.label in options.rows
    seeds = options.seeds if asked else len(list((folder / row.label).glob("seed_*.json")))
    resume = options.resume or not asked
    for seed in range(seeds):
        run = compare.run_one(scene, row.label, row.refinement, seed, folder, environment, resume)
        row.curves.append(run)


def _curves(row):
    """How the first seed refined: iterations a solve took in the mean, and the tolerance, of each interval."""
    k = row.taken_per_solve()[0]
    return {"iterations": [float(f"{x:.4g}") for x in k], "rtol": [float(f"{x:.3g}") for x in row.curves[0]["rtol"]]}


if __name__ == "__main__":
    main()
