"""`load_trained`: a network that `prdp train` or `prdp compare` has trained."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from prdp_torch import fields
from prdp_torch.experiments import _C, network_task, own_networks, records
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.scenes import placed
from prdp_torch.experiments.training import Curves


class Trained(NamedTuple):
    """A trained network, ready to use. Call it to make one time step."""

    network: torch.nn.Module
    """With its trained weights, in evaluation mode."""
    step: Callable[[Tensor], Tensor]
    """One time step u → u_next, both (batch, channels, *shape): the network itself, or for the task `corrector` the
    coarse solver with the network on top."""
    scene: _C.Scene
    """The scene as it was trained."""
    curves: Curves
    """The curves of the record, as `training.train` returns them."""

    def __repr__(self) -> str:
        weights = sum(parameter.numel() for parameter in self.network.parameters())
        return f"Trained({self.scene.name}: {type(self.network).__name__}, {weights} weights)"

    def __call__(self, u: Tensor) -> Tensor:
        """Make one time step."""
        return self.step(u)

    def rollout(self, u: Tensor, steps: int) -> Tensor:
        """Repeat the step. Returns all states, u included: (batch, steps + 1, channels, *shape)."""
        return fields.rollout(self.step, u, steps)


def load_trained(run_folder: str | Path, seed: int = 0, device: str | torch.device = "cpu") -> Trained:
    """Load a trained network from the folder of its training.

    Args:
        run_folder: the folder with the records, such as "runs/heat_1d-train/prdp". The folder above it
            will do if it holds a single way of choosing K.
        seed: which of the trainings.
        device: where the network shall be, such as "cuda"; it may have been trained on any other.

    Returns:
        A `Trained`. Call it for one time step, or use its `rollout(u, steps)`. Wrap the call in
        `torch.no_grad()` if you need no gradient.

    Raises:
        ValueError: no record or no weights are there, they are damaged or do not belong together, or the
            training diverged. Or there is no such device here.

    If the scene has a network of your own, `network = "module:Class"`, the module is imported from where it was for the
    training. Then load only records that you trust; other records run no code.

    Examples:
        >>> emulator = prdp.load_trained("runs/heat_1d-train/prdp")
        >>> states = emulator.rollout(u0, steps=10)  # (batch, 1, 30) -> (batch, 11, 1, 30)
    """
    path = _record_in(Path(run_folder), f"seed_{seed}.json")
    record = records.read_training(path)
    assert record is not None
    scene = placed(records.scene_of(path, record), device)
    if not scene.trains_network:
        kept = records.weights_of(path)
        of_field = ".exp()" if scene.task == "field" else ""
        found = f"torch.load('{kept}')['theta']{of_field} is what it found" if kept.exists() else f"read '{path}'"
        raise ValueError(f"load_trained: the scene '{scene.name}' trains no network; {found}")
    if "diverged" in record["curves"]:
        raise ValueError(f"load_trained: the training of '{path}' diverged, {record['curves']['diverged']}")
    network = records.read_weights(path, make_network(scene, seed, without_memory=True), record)
    if scene.network.python:
        own_networks.warn_if_changed(scene, record["settings"].get("network"))
    if network is None:
        raise ValueError(
            f"load_trained: '{records.weights_of(path)}', the weights that belong to the record, is missing"
        )
    network.to(scene.device)
    return Trained(network, network_task.propagator(scene, network), scene, record["curves"])


def _record_in(folder: Path, name: str) -> Path:
    """The path of a record in a folder of records, or in the only such folder inside it."""
    if (folder / name).exists():
        return folder / name
    found = sorted(folder.glob(f"*/{name}"))
    if len(found) == 1:
        return found[0]
    if found:
        labels = ", ".join(path.parent.name for path in found)
        raise ValueError(f"load_trained: '{folder}' holds several trainings; add one of {labels} to the path")
    others = ", ".join(sorted(str(path.relative_to(folder)) for path in folder.rglob("seed_*.json"))) or "no record"
    raise ValueError(f"load_trained: no '{name}' in '{folder}'; it holds {others}")
