"""The parts of auto one by one, beside PRDP, constant tolerances and converged solves:
`python -m benchmarks.refinement SCENE`.

Writes a record for each training and a summary, as `prdp compare` does, and prints its rows. The summaries kept in
docs/results are what docs/result_tables.py and `python -m benchmarks.refinement_charts` read. With --resume, finished
trainings are kept. With --rows, only these are trained: the summary takes the others from --keep, an earlier summary.
"""

import argparse
import json
import re
import time
from pathlib import Path

import torch

from prdp_torch.controller import LinearSchedule, PRDPController, ToleranceController
from prdp_torch.experiments import _C, compare, records, scenes
from prdp_torch.experiments.compare import Row
from prdp_torch.experiments.refinement import Refinement, start_from_states

TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)
WITH_MULTIGRID = (1e-2, 1e-3)
OF_PARAMETERS = (*TOLERANCES, 1e-5)  # without a network, their error falls as far as the solves allow
MULTIGRID = {  # the solvers that `prdp advise` finds where the solves are most of an update; and for Poisson
    "poisson_1p": 'method = "cg"\npreconditioner = "multigrid"\nmax_iter = 100',
    "poisson_3p": 'method = "cg"\npreconditioner = "multigrid"\nmax_iter = 100',
    "poisson_3p_sd": 'method = "cg"\npreconditioner = "multigrid"\nmax_iter = 100',
    "heat_3d": 'method = "cg"\npreconditioner = "multigrid"\nmax_iter = 100',
    "burgers_2d": 'method = "multigrid"\nmax_iter = 50',
    "burgers_2d_192": 'method = "multigrid"\nmax_iter = 50',
    "diffusion_inverse": 'method = "cg"\npreconditioner = "multigrid"\nmax_iter = 100',
    "diffusion_inverse_256": 'method = "cg"\npreconditioner = "multigrid"\nmax_iter = 100',
}


def rows_of(scene):
    converged = scene.max_iter
    rows = [
        Row("converged", f"converged, K = {converged}", "converged", Refinement.constant(converged), converged),
        Row("prdp", "PRDP, tuned", "prdp", Refinement.prdp(scene)),
        Row("prdp_defaults", "PRDP, defaults", "prdp", Refinement("prdp_defaults", PRDPController)),
        _tolerance("tolerance", "tolerance", adjoint_ratio=1.0, adjoint_floor=1e-5),
        _tolerance("tolerance_adjoint", "tolerance, adjoint looser"),
        Row("auto", "auto: with the start as well", "auto", Refinement.auto()),
        *map(_constant, OF_PARAMETERS if scene.task == "parameters" else TOLERANCES),
    ]
    if scene.physics.direct_is_cheap or scene.task == "field" or scene.physics.force is not None:
        rows.append(Row("direct", "direct solver", "direct", Refinement.exact(), 1))
    if scene.name in MULTIGRID:
        rows.append(Row("multigrid", "converged, multigrid", "tolerance", Refinement.tolerance(1e-5, 100)))
        rows.append(Row("auto_multigrid", "auto, multigrid", "auto", Refinement.auto()))
        rows.extend(_constant(rtol, "multigrid") for rtol in WITH_MULTIGRID)
    if scene.task == "corrector":
        rows.append(
            Row("none", f"K = {converged}, backward none", "constant", Refinement.constant(converged), converged)
        )
    return rows


def _tolerance(label, title, **settings):
    refinement = Refinement(label, lambda steppers: ToleranceController(steppers, **settings), watches_error=True)
    return Row(label, title, "auto", refinement)


def _constant(rtol, solver=None):
    """One tolerance throughout, ten times as large for the adjoint, but at most 1/2. Start and cap on K are auto's."""

    def attach(steppers):
        start_from_states(steppers)
        for stepper in steppers:
            stepper.rtol, stepper.adjoint_rtol = rtol, min(0.5, 10 * rtol)
        return LinearSchedule(steppers, initial=10_000, increment=0, maximum=10_000)

    label, title = f"rtol_{rtol:g}", f"rtol = {rtol:g} throughout"
    if solver:
        label, title = f"{solver}_{label}", f"{title}, {solver}"
    return Row(label, title, "tolerance", Refinement(label, attach))


def scene_of(name, row, device=None):
    """The scene as the row trains it."""
    scene = scenes.load(name)
    if row.label == "none":
        scene.backward = "none"
    if "multigrid" in row.label:
        solver = f'[solver]\n{MULTIGRID[scene.name]}\nrtol = 1e-5\nbackward = "implicit"\n\n'
        text = re.sub(r"\[solver\]\n.*?\n\n", lambda _: solver, scene.text, flags=re.DOTALL)
        scene = _C.parse_scene(text, scene.path)
    return scenes.placed(scene, device)


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.refinement")
    parser.add_argument("scene")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rows", nargs="+", help="labels of the rows to train; all where none is given")
    parser.add_argument("--keep", type=Path, help="a summary whose rows are kept where they are not trained")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--device", help="where to train; default: where the scene says")
    parser.add_argument("--resume", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    scene = scenes.placed(scenes.load(options.scene), options.device)
    folder = records.prepare_folder(options.out or Path("runs") / f"{scene.name}-refinement")
    kept = json.loads(options.keep.read_text()) if options.keep else {"rows": [], "curves": {}}
    environment = records.environment(None if scene.device.type == "cpu" else scene.device)
    asked = [row for row in rows_of(scene) if not options.rows or row.label in options.rows]
    summary = {"settings": records.settings(scene), **environment, "seeds": options.seeds, **kept}
    for row in asked:
        shares = train(row, options, folder, environment)
        (entry,) = compare.summarise(scene, [row])
        entry |= {key: environment[key] for key in ("commit", "machine")} | {"share_of_a_core": shares}
        print(f"{row.title}: {entry['metric']:.2e}, {entry['operator_applications']:,.0f} products", flush=True)
        order = [other.label for other in rows_of(scene)]
        others = [other for other in summary["rows"] if other["label"] != row.label]
        summary["rows"] = sorted([*others, entry], key=lambda entry: order.index(entry["label"]))
        summary["curves"][row.label] = _curves(row)
        base = next((entry for entry in summary["rows"] if entry["label"] == "converged"), None)
        if base:
            compare.judge(summary["rows"], base)
        records.write(folder / "summary.json", summary)


def train(row, options, folder, environment):
    """Fill in the curves of a row, one for each seed. Returns the CPU seconds per second of each training: less than
    1 where other programs had the core, None where the training was there before."""
    shares = []
    for seed in range(options.seeds):
        scene = scene_of(options.scene, row, options.device)
        began, cpu = time.perf_counter(), time.process_time()
        run = compare.run_one(scene, row.label, row.refinement, seed, folder, environment, options.resume)
        passed, cpu = time.perf_counter() - began, time.process_time() - cpu
        row.curves.append(run)
        shares.append(round(cpu / passed, 3) if passed > sum(run["seconds"]) else None)
    return shares


def _curves(row):
    """How the first seed refined, interval by interval: iterations a solve took in the mean, the tolerance and, where
    intervals are few, what it reached at which cost."""
    curves, few = row.curves[0], 200
    costs = ("metric", "operator_applications", "seconds") if len(curves["rtol"]) <= few else ()
    kept = {"iterations": row.taken_per_solve()[0], **{name: curves[name] for name in ("rtol", *costs)}}
    return {name: [float(f"{x:.4g}") for x in curve] for name, curve in kept.items()}


if __name__ == "__main__":
    main()
