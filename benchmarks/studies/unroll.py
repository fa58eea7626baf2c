"""When must the gradient go through the solver? Networks trained through m solver steps in a row, with the exact
adjoint, with one of a few iterations, and with none: then each step learns from its own error alone.

navier_stokes, coarser than its scene: u ← û + network(û), û the coarse step. burgers_1d: u ← network(û), û the
solver's step, so that the network stands for every second step. Trainings take turns on a machine, so their seconds
are those of the processor."""

import functools
import time

import numpy as np
import torch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from benchmarks.studies.evaluation import seeds_of, spread
from benchmarks.studies.trainings import variant
from prdp_torch.experiments import _C, records, scenes
from prdp_torch.experiments.charts import make_figure
from prdp_torch.experiments.network_task import corrected, error
from prdp_torch.experiments.networks import make_network

STEPS = (2, 4, 8, 16)
BEYOND = (20, 40)  # how far the trained network is followed
TRAIN, VALID = 200, 20
UPDATES = {"burgers_1d": 400, "navier_stokes": 500}
BATCH = {"burgers_1d": 25, "navier_stokes": 10}
CHANGES = {  # the corrector starts as no correction: 16 steps of an untrained one leave the scene
    "burgers_1d": {},
    "navier_stokes": {
        "physics.shape": [24, 24], "data.reference_shape": [49, 49], "network.width": 32, "network.zero_output": True,
    },
}  # fmt: skip
GRADIENTS = {  # options of the stepper
    "exact": {"backward": "implicit"},
    "three iterations": {"backward": "implicit", "adjoint_max_iter": 3},
    "none": {"backward": "none"},
}
UNCLIPPED = {f"{gradient}, unclipped": GRADIENTS[gradient] for gradient in ("exact", "none")}


def run(study, seeds, quick):
    for seed in range(seeds):
        for name in list(CHANGES)[:1] if quick else CHANGES:
            for steps in STEPS[:1] if quick else STEPS:
                for gradient in GRADIENTS:
                    _kept(study, name, steps, gradient, seed, 5 if quick else UPDATES[name])
    for name in () if quick else CHANGES:  # whether it is the clipping that tells the gradients apart
        for steps in STEPS[1:]:
            for gradient in UNCLIPPED:
                _kept(study, name, steps, gradient, 0, UPDATES[name])


def _kept(study, name, steps, gradient, seed, updates):
    label = f"{name}_{steps}_{gradient.replace(',', '').replace(' ', '_')}_seed{seed}"
    path = study.folder / f"{label}.json"
    row = records.read(path)
    if row is None or (row["updates"], row["changes"]) != (updates, CHANGES[name]):
        row = {
            "scene": name, "steps": steps, "gradient": gradient, "seed": seed, "updates": updates,
            "changes": CHANGES[name], **train(name, steps, gradient, seed, updates), **records.environment(),
        }  # fmt: skip
        records.write_training(path, row)
    study.report(f"{label}: {row['trained']:.3e} after {steps}, {row['beyond'][-1]:.3e} after {BEYOND[-1]}")
    study.rows.append(row)


@functools.cache
def trajectories(name):
    """The scene, and its trajectories to learn from and to validate with, one state for each step of ours."""
    every = 1 if name == "navier_stokes" else 2
    train, valid = (
        variant(name, {**CHANGES[name], "data.valid": samples, "data.seed": seed})
        for seed, samples in enumerate((TRAIN, VALID))
    )
    to_learn = _C.validation_trajectories(train, STEPS[-1] * every)[:, ::every]
    return valid, to_learn, _C.validation_trajectories(valid, BEYOND[-1] * every)[:, ::every]


def make_steppers(scene, gradient, steps):
    """One for each step, so that each keeps the report of its adjoint solve."""
    steppers = [scenes.make_stepper(scene) for _ in range(steps)]
    for stepper in steppers:
        for option, value in {**GRADIENTS, **UNCLIPPED}[gradient].items():
            setattr(stepper, option, value)
    return steppers


def train(name, steps, gradient, seed, updates):
    scene, train_states, valid_states = trajectories(name)
    steppers = make_steppers(scene, gradient, steps)
    network = make_network(scene, seed)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates, eta_min=1e-4)
    generator = torch.Generator().manual_seed(seed)
    started, forward, adjoint = time.process_time(), 0.0, 0.0
    for _ in range(updates):
        batch = train_states[torch.randperm(TRAIN, generator=generator)[: BATCH[name]]]
        u, loss = batch[:, 0], 0.0
        for step, stepper in enumerate(steppers, 1):
            u = next_state(name, stepper, network, u)
            loss = loss + _C.loss(scene.training.loss, u, batch[:, step])
        optimiser.zero_grad()
        loss.backward()
        if gradient not in UNCLIPPED:
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        forward += sum(_products(stepper.info) for stepper in steppers)
        adjoint += sum(_products(stepper.adjoint_info) for stepper in steppers)
    seconds = time.process_time() - started
    errors = follow(name, scene, network, valid_states)
    return {
        "trained": errors[steps], "beyond": [errors[n] for n in BEYOND], "errors": errors, "seconds": seconds,
        "forward_products": forward, "adjoint_products": adjoint, "loss": float(loss.detach()),
        "alone": follow(name, scene, torch.zeros_like, valid_states) if name == "navier_stokes" else None,
    }  # fmt: skip


def _products(info):
    """Products with A of a solve, per sample; of no solve, none."""
    return 0.0 if info is None else float(info.operator_applications.double().mean())


def next_state(name, stepper, network, u):
    return network(stepper(u)) if name == "burgers_1d" else corrected(stepper, network, u)


def follow(name, scene, network, states):
    """The error after each step, the start's zero included; the velocity's alone for navier_stokes."""
    stepper = scenes.make_stepper(scene)
    u, errors = states[:, 0], [0.0]
    with torch.no_grad():
        for step in range(1, states.shape[1]):
            u = next_state(name, stepper, network, u)
            errors.append(error(scene, u, states[:, step]))
    return errors


def _of(rows, name, steps, gradient):
    return [row for row in rows if (row["scene"], row["steps"], row["gradient"]) == (name, steps, gradient)]


def table(rows):
    heads = ["scene", "steps trained", "gradient", "error after them", *(f"after {n}" for n in BEYOND)]
    heads += ["forward products", "adjoint products", "s"]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for name in CHANGES:
        for steps in STEPS:
            for gradient in (*GRADIENTS, *UNCLIPPED):
                chosen = _of(rows, name, steps, gradient)
                if chosen:
                    # "errors" is rounded to four digits; a spread of them would be computed from rounded numbers
                    exact = [(row["trained"], *row["beyond"]) for row in chosen]
                    errors = [spread(values) for values in zip(*exact, strict=True)]
                    costs = [np.mean([row[f"{kind}_products"] for row in chosen]) for kind in ("forward", "adjoint")]
                    costs.append(min(row["seconds"] for row in chosen))
                    cells = [*errors, *(f"{cost:,.0f}" for cost in costs)]
                    lines.append(f"| {name} | {steps} | {gradient} | {' | '.join(cells)} |")
    return "\n".join(lines)


def chart(rows):
    """The errors as ratios to those without a gradient: bars reach from the lowest to the highest seed."""
    figure, panels = make_figure(panels=2)
    for axes, name in zip(panels, CHANGES, strict=True):
        axes.axhline(1.0, color=COLOURS["none"], lw=2, label="none")
        for at, gradient in enumerate(("exact", "three iterations")):
            for n, line, shift in zip(BEYOND, ("-", ":"), (0.96, 1.04), strict=True):
                found = [(m, *_ratios(rows, name, m, gradient, n)) for m in STEPS if _of(rows, name, m, gradient)]
                if not found:
                    continue
                x, middle, low, high = map(np.array, zip(*found, strict=True))
                axes.errorbar(
                    x * shift * (1 + 0.02 * at), middle, [middle - low, high - middle], color=COLOURS[gradient],
                    ls=line, marker="o", ms=5, capsize=3, label=f"{gradient}, {n} steps",
                )  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="steps that are trained through", title=name)
        axes.set_xticks(STEPS, STEPS)
        axes.yaxis.set_major_locator(FixedLocator(RATIOS))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_minor_locator(NullLocator())
        axes.grid(alpha=0.3, lw=0.4)
    panels[0].set_ylabel("error / error without a gradient")
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, fontsize=8,
        title=f"gradient through the solver, and how far the network is followed ({seeds_of(rows)})",
    )  # fmt: skip
    return figure


COLOURS = {"exact": "#222222", "three iterations": "#1f77b4", "none": "#d62728"}
RATIOS = (0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5)


def _ratios(rows, name, steps, gradient, n):
    """The ratio of the mean errors after n steps, and the lowest and the highest of the seeds."""
    these, none = (
        {row["seed"]: row["errors"][n] for row in _of(rows, name, steps, kind)} for kind in (gradient, "none")
    )
    each = [these[seed] / none[seed] for seed in these]
    return np.mean([*these.values()]) / np.mean([*none.values()]), min(each), max(each)
