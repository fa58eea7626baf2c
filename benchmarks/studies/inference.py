"""How far must the solver go when a trained corrector is used? The error and the time of each K, for the networks of
`python -m benchmarks.refinement navier_stokes`. Beside the record it draws what they predict."""

import time

import numpy as np
import torch

import prdp_torch as prdp
from benchmarks.studies.evaluation import seeds_of
from benchmarks.studies.trainings import variant
from prdp_torch.experiments import _C, records, trajectory_charts
from prdp_torch.experiments.charts import make_figure, write_png
from prdp_torch.experiments.network_task import corrected, error
from prdp_torch.experiments.scenes import make_stepper
from prdp_torch.experiments.trajectories import Course, Trajectories

WAYS = {"converged": "#222222", "prdp": "#d62728", "auto": "#1f77b4"}
COARSE = "coarse solver alone"
KS = (1, 2, 4, 8, 12, 16, 24, 120)  # with 120 every solve meets the scene's rtol
STEPS = (5, 10, 20, 50)
ENERGY = 20  # after which the kinetic energy is compared with the reference's
PICTURES = 20  # steps that the snapshots show
VALID = 10


def run(study, seeds, quick):
    found = [path for how in WAYS for path in sorted((study.trainings / how).glob("seed_*.pt"))]
    if not found:
        raise SystemExit(
            f"inference: no trained network in {study.trainings}; run 'python -m benchmarks.refinement navier_stokes'"
        )
    last = STEPS[0] if quick else STEPS[-1]
    networks = {(path.parent.name, _seed(path)): prdp.load_trained(path.parent, _seed(path)) for path in found}
    scene = variant("navier_stokes", {"data.valid": 2 if quick else VALID})
    states = _C.validation_trajectories(scene, last)
    courses = [_course(study, scene, COARSE, 0, KS[-1], torch.zeros_like, states)]
    for (how, seed), trained in networks.items():
        for k in KS[-2:] if quick else KS:
            course = _course(study, scene, how, seed, k, trained.network, states)
        if seed == 0:
            courses.append(course)
    if not quick:
        shown = Trajectories(states[:, : PICTURES + 1], courses, [])
        write_png(trajectory_charts.snapshots(scene, shown), study.folder / "snapshots.png", dpi=110)


def _seed(path):
    return int(path.stem.split("_")[1])


def _course(study, scene, how, seed, k, network, states):
    """Follow the validation samples with solves of at most k iterations. Its row goes to the study."""
    stepper, seconds = make_stepper(scene, max_iter=k), {"solve": [], "step": []}

    def solve(u):
        return _timed(seconds["solve"], stepper, u)

    reached, errors, energies, products = [states[:, 0]], [0.0], [1.0], 0.0
    with torch.no_grad():
        for n in range(1, states.shape[1]):
            reached.append(_timed(seconds["step"], corrected, solve, network, reached[-1]))
            errors.append(error(scene, reached[-1], states[:, n]))
            energies.append(float(_energy(reached[-1]) / _energy(states[:, n])))
            products += float(stepper.info.operator_applications.double().mean())
    samples, steps = len(states), len(errors) - 1
    row = {
        "how": how, "seed": seed, "k": k, "errors": errors, "energies": energies, "products_a_step": products / steps,
        **{f"{part}_ms": 1e3 * float(np.median(values)) / samples for part, values in seconds.items()},
        **records.environment(),
    }  # fmt: skip
    study.report(f"{how}, seed {seed}, K = {k}: {errors[-1]:.3e} after {steps} steps")
    study.rows.append(row)
    kind = "coarse" if how == COARSE else how
    return Course(how, kind, torch.stack(reached[: PICTURES + 1], 1), np.array([errors[1:]]))


def _energy(states):
    """The mean of u₁² + u₂² over grid and samples."""
    return states[:, :2].square().sum(1).mean()


def _timed(seconds, function, *arguments):
    """Its result. The seconds are the processor's: others may share it."""
    started = time.process_time()
    result = function(*arguments)
    seconds.append(time.process_time() - started)
    return result


def _of(rows, how, k):
    return [row for row in rows if row["how"] == how and row["k"] == k]


def _steps(rows):
    return [n for n in STEPS if n < len(rows[0]["errors"])]


def _mean(rows, key, n=None):
    return np.mean([row[key] if n is None else row[key][n] for row in rows])


def table(rows):
    steps = _steps(rows)
    heads = [
        *(f"error after {n}" for n in steps),
        f"energy after {min(ENERGY, steps[-1])}",
        "products per step",
        "ms, solve",
        "ms, step",
    ]
    lines = [f"| trained with | K | {' | '.join(heads)} |", "|---" * (len(heads) + 2) + "|"]
    for how in (COARSE, *WAYS):
        for k in sorted({row["k"] for row in rows if row["how"] == how}):
            chosen = _of(rows, how, k)
            cells = [f"{_mean(chosen, 'errors', n):.2e}" for n in steps]
            cells += [f"{_mean(chosen, 'energies', min(ENERGY, steps[-1])):.2f}"]
            cells += [f"{_mean(chosen, 'products_a_step'):.0f}"]
            cells += [f"{_mean(chosen, part):.2f}" for part in ("solve_ms", "step_ms")]
            lines.append(f"| {how} | {k} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _over_time(rows):
    errors = np.mean([row["errors"][1:] for row in rows], 0)
    return np.arange(1, 1 + len(errors)), errors


def chart(rows):
    figure, (left, right) = make_figure(panels=2)
    ks = sorted({row["k"] for row in rows})
    for how, colour in WAYS.items():
        if not _of(rows, how, ks[-1]):
            continue
        for n, line in zip(_steps(rows), ("-", "--", ":"), strict=False):
            found = [(k, _mean(_of(rows, how, k), "errors", n)) for k in ks if _of(rows, how, k)]
            left.plot(*zip(*found, strict=True), color=colour, ls=line, marker="o", ms=4, label=f"{how}, {n} steps")
        right.plot(*_over_time(_of(rows, how, ks[-1])), color=colour, label=f"corrected, {how}")
    right.plot(*_over_time(_of(rows, COARSE, ks[-1])), color="#888888", ls="--", label=COARSE)
    left.set(xscale="log", yscale="log", xlabel="K", ylabel="error of the velocity along x")
    left.set_xticks(ks, ks)
    left.minorticks_off()
    right.set(yscale="log", xlabel="steps")
    for axes in (left, right):
        axes.grid(alpha=0.3, lw=0.4)
    left.set_title("K of the solves in use", fontsize=10)
    right.set_title("converged solves", fontsize=10)
    figure.suptitle(f"navier_stokes, trained correctors in use ({seeds_of(rows)})", fontsize=11)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower left", frameon=False, ncols=3, fontsize=8)
    right.legend(frameon=False)
    return figure
