"""What trained networks do from the validation samples on, beside the reference: the arrays behind the
pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from prdp_torch import fields
from prdp_torch.experiments import _C, datasets, records
from prdp_torch.experiments.compare import Row
from prdp_torch.experiments.datasets import OnData
from prdp_torch.experiments.network_task import error, propagator
from prdp_torch.experiments.networks import make_network

_SHOWN = ("converged", "auto", "prdp")  # kinds of rows
_FURTHER = 4  # the pictures go on to this many times the step of the metric


@dataclass
class Course:
    """One way of stepping on from the validation samples."""

    title: str
    kind: str
    """Of the row; or "coarse", the coarse solver without a network."""
    states: torch.Tensor
    """(samples, steps + 1, channels, *shape), the start included; with the first seed's network."""
    errors: np.ndarray
    """(seeds, steps), after each step, as the validation metric measures them."""


@dataclass
class Trajectories:
    reference: torch.Tensor
    """(samples, steps + 1, channels, *shape), as `datasets.reference` makes them."""
    courses: list[Course]
    missing: list[str]
    """Titles of the trainings that left no weights, or diverged."""


def exist(scene: _C.Scene) -> bool:
    """Whether the network of a scene is trained on states that follow each other in time."""
    return scene.trains_network and scene.physics.equation != "darcy"


def collect(scene: _C.Scene, rows: list[Row], folder: Path, on_data: OnData | None = None) -> Trajectories | None:
    """Follow the validation samples with the networks of converged training, of auto and of PRDP, whose weights
    lie beside their records in `folder`. None for a task without a network or without time, or if there are no weights.

    on_data: called while the reference is made with (steps of a sample done, all of them).
    """
    if not exist(scene):
        return None
    rows = [row for row in rows if row.kind in _SHOWN]
    networks = {row.label: _networks(scene, row, folder) for row in rows}
    if not any(networks.values()):
        return None
    reference = datasets.reference(scene, _FURTHER * scene.data.valid_steps, on_data)
    courses = [
        _follow(scene, row.title, row.kind, networks[row.label], reference) for row in rows if networks[row.label]
    ]
    if scene.task == "corrector":
        courses.insert(0, _follow(scene, "coarse solver alone", "coarse", [torch.zeros_like], reference))
    return Trajectories(reference.cpu(), courses, [row.title for row in rows if not networks[row.label]])


def field(scene: _C.Scene, states: Tensor) -> Tensor:
    """What the pictures show of states (time, channels, *shape), as (time, *shape): the vorticity of a flow,
    else the first component."""
    if scene.task == "corrector":
        states = fields.curl(states, scene.physics.length)
    return states[:, 0]


def _networks(scene: _C.Scene, row: Row, folder: Path) -> list[torch.nn.Module]:
    """The networks of the seeds that did not diverge and whose weights are there."""
    networks = [
        records.read_weights(folder / row.label / f"seed_{seed}.json", make_network(scene, seed))
        for seed in range(len(row.curves))
        if "diverged" not in row.curves[seed]
    ]
    return [network.to(scene.device) for network in networks if network is not None]


def _follow(
    scene: _C.Scene, title: str, kind: str, networks: Sequence[Callable[[Tensor], Tensor]], reference: Tensor
) -> Course:
    steps = reference.shape[1] - 1
    with torch.no_grad():
        runs = [fields.rollout(propagator(scene, network), reference[:, 0], steps) for network in networks]
    errors = [[error(scene, run[:, n], reference[:, n]) for n in range(1, steps + 1)] for run in runs]
    return Course(title, kind, runs[0].cpu(), np.array(errors))
