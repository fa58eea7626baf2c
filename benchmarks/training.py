"""An update of a training: what the physics costs beside the network, at K_ε and at K = 1."""

import torch

from benchmarks import measure
from prdp_torch.experiments import _C, scenes
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.scenes import make_stepper

SCENES = ["heat_1d", "heat_2d", "burgers_1d", "burgers_2d", "heat_3d", "navier_stokes"]


def run(report, quick=False):
    """[{scene, k, network_seconds, update_seconds, loss}] of the emulator and the corrector scenes."""
    found = []
    for name in [scene for scene in SCENES if scene in scenes.available()][: 1 if quick else None]:
        report(f"update of a training: {name}")
        found += updates(scenes.load(name), quick)
    return found


def updates(scene, quick):
    """One batch, over and over: the whole update with two K, and the same with the physics left out."""
    data = _C.make_dataset(scene, lambda done, total: None)
    batch = scene.training.batch
    start = data.train_start[:batch]
    network = make_network(scene, 0)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-6, fused=True)

    def update(steppers):
        optimiser.zero_grad()
        u = start
        for stepper in steppers:
            u = u + network(u) if scene.task == "corrector" else network(u)
            if stepper is not None:
                u = stepper(u)
        loss = _C.loss(scene.training.loss, u, data.train_end[:batch])
        loss.backward()
        optimiser.step()
        return float(loss.detach())

    budgets = {None: [None] * scene.executions}
    for k in (1, scene.max_iter):
        budgets[k] = [make_stepper(scene, max_iter=k) for _ in range(scene.executions)]
    losses = {k: update(steppers) for k, steppers in budgets.items()}
    calls = {k: (lambda steppers=steppers: update(steppers)) for k, steppers in budgets.items()}
    seconds = measure.interleaved(calls, rounds=3 if quick else 5)
    return [
        {"scene": scene.name, "k": k, "network_seconds": seconds[None]["min"], "update_seconds": seconds[k]["min"],
         "loss": losses[k]}
        for k in (1, scene.max_iter)
    ]  # fmt: skip
