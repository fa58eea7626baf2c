"""When must the gradient go through the solver? Networks trained through m solver steps in a row, with the exact
adjoint, with one of a few iterations, and with none: then each step learns from its own error alone.

navier_stokes, coarser than its scene: u ← û + network(û), û the coarse step. burgers_1d: u ← network(û), û the
solver's step, so that the network stands for every second step."""

import time

import numpy as np
import torch

from benchmarks.studies.evaluation import spread
from benchmarks.studies.trainings import variant
from prdp_torch import _C
from prdp_torch.experiments import records, scenes
from prdp_torch.experiments.charts import make_figure
from prdp_torch.experiments.network_task import corrected, error
from prdp_torch.experiments.networks import make_network

STEPS = (2, 4, 8, 16)
BEYOND = 20  # how far the trained network is followed
TRAIN, VALID, BATCH = 200, 20, 25
UPDATES = {"navier_stokes": 400, "burgers_1d": 800}
CHANGES = {
    "navier_stokes": {"physics.shape": [24, 24], "data.reference_shape": [49, 49]},
    "burgers_1d": {},
}
GRADIENTS = {  # options of the stepper
    "exact": {"backward": "implicit"},
    "three iterations": {"backward": "implicit", "adjoint_max_iter": 3},
    "none": {"backward": "none"},
}


def run(study, seeds, quick):
    for name in list(CHANGES)[1:] if quick else CHANGES:
        for steps in STEPS[:1] if quick else STEPS:
            for gradient in GRADIENTS:
                for seed in range(min(seeds, 3)):
                    _kept(study, name, steps, gradient, seed, 5 if quick else UPDATES[name])


def _kept(study, name, steps, gradient, seed, updates):
    label = f"{name}_{steps}_{gradient.replace(' ', '_')}_seed{seed}"
    path = study.folder / f"{label}.json"
    row = records.read(path)
    if row is None or row["updates"] != updates:
        row = {
            "scene": name, "steps": steps, "gradient": gradient, "seed": seed, "updates": updates,
            "changes": CHANGES[name], **train(name, steps, gradient, seed, updates), **records.environment(),
        }  # fmt: skip
        records.write_training(path, row)
    study.report(f"{label}: {row['trained']:.3e} after {steps}, {row['beyond']:.3e} after {BEYOND}")
    study.rows.append(row)


def train(name, steps, gradient, seed, updates):
    every = 1 if name == "navier_stokes" else 2  # solver steps of the reference to one of ours
    scene = variant(name, {**CHANGES[name], "data.valid": TRAIN + VALID})
    states = _C.validation_trajectories(scene, BEYOND * every)[:, ::every]
    train_states, valid_states = states[:TRAIN], states[TRAIN:]
    stepper = scenes.make_stepper(scene)
    stepper.adjoint_max_iter = GRADIENTS[gradient].get("adjoint_max_iter")
    stepper.backward = GRADIENTS[gradient]["backward"]
    network = make_network(scene, seed)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates, eta_min=1e-4)
    generator = torch.Generator().manual_seed(seed)
    started, products = time.perf_counter(), 0.0
    for _ in range(updates):
        chosen = torch.randperm(TRAIN, generator=generator)[:BATCH]
        batch = train_states[chosen]
        u, loss = batch[:, 0], 0.0
        for step in range(1, steps + 1):
            u = next_state(name, stepper, network, u)
            products += float(stepper.info.operator_applications.double().mean())
            loss = loss + _C.normalised_mse(u, batch[:, step])
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    seconds = time.perf_counter() - started
    errors = follow(name, scene, network, valid_states)
    return {
        "trained": errors[steps], "beyond": errors[BEYOND], "errors": errors,
        "seconds": seconds, "forward_products": products, "loss": float(loss.detach()),
    }  # fmt: skip


def next_state(name, stepper, network, u):
    return network(stepper(u)) if name == "burgers_1d" else corrected(stepper, network, u)


def follow(name, scene, network, states):
    """The error after each step, the start's zero included; the velocity's alone for navier_stokes."""
    stepper = scenes.make_stepper(scene)
    u, errors = states[:, 0], [0.0]
    with torch.no_grad():
        for step in range(1, BEYOND + 1):
            u = next_state(name, stepper, network, u)
            errors.append(error(scene, u, states[:, step]))
    return errors


def _values(rows, name, steps, gradient, key):
    return [r[key] for r in rows if r["scene"] == name and r["steps"] == steps and r["gradient"] == gradient]


def table(rows):
    lines = [
        "| scene | steps trained | gradient | error after them | error after 20 | s |",
        "|---|---|---|---|---|---|",
    ]
    for name in CHANGES:
        for steps in STEPS:
            for gradient in GRADIENTS:
                trained, beyond, seconds = (
                    _values(rows, name, steps, gradient, key) for key in ("trained", "beyond", "seconds")
                )
                if trained:
                    lines.append(
                        f"| {name} | {steps} | {gradient} | {spread(trained)} | {spread(beyond)} "
                        f"| {np.mean(seconds):.0f} |"
                    )
    return "\n".join(lines)


def chart(rows):
    figure, panels = make_figure(panels=2)
    for axes, name in zip(panels, CHANGES, strict=True):
        for gradient, colour in zip(GRADIENTS, ("#222222", "#1f77b4", "#d62728"), strict=True):
            found = [(m, _values(rows, name, m, gradient, "beyond")) for m in STEPS]
            found = [(m, values) for m, values in found if values]
            if found:
                axes.errorbar(
                    [m for m, _ in found], [np.mean(v) for _, v in found], [np.std(v) for _, v in found],
                    color=colour, marker="o", capsize=3, label=gradient,
                )  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="steps that are trained through", title=name)
        axes.set_xticks(STEPS, STEPS)
        axes.grid(alpha=0.3, lw=0.4)
    panels[0].set_ylabel(f"error after {BEYOND} steps, 20 samples")
    panels[0].legend(title="gradient through the solver", frameon=False)
    return figure
