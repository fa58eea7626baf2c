"""Checkpoints: the state of a running training, so that it can continue after it was killed."""

import json
import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from itertools import zip_longest
from pathlib import Path
from typing import Any, TypeAlias

import torch
from torch import Tensor

from prdp_torch import data_parallel
from prdp_torch.experiments import _C

Found: TypeAlias = list[tuple[Path, bytes, str]]


class Checkpoint(_C.Checkpoint):
    """The checkpoint file of one training.

    Args:
        path: the file. It is written to a temporary name first, so it is never half written.
        settings: everything that the training depends on. A file with other settings is ignored; see `refuse_other`.
    """

    def __init__(self, path: str | os.PathLike[str], **settings: Any) -> None:
        self._path = Path(path)
        self._settings = {"trainer": "Python", **settings}
        super().__init__(path, json.dumps(self._settings))

    def refuse_other(self, record: Path) -> None:
        """ValueError, naming a setting that differs, where the file is of an unfinished training with other settings,
        which one that begins here would overwrite."""
        self.remove_before(record)
        for path in (self._path, self._path.with_name(f"{self._path.name}.before")):
            there = _settings_in(path)
            if there is not None and there != self._settings:
                raise ValueError(
                    f"checkpoint: '{path}' is of a training that has not ended, with other settings: "
                    f"{difference(there, self._settings)}; give its settings and --resume to go on with it, or another "
                    "--out, or delete the file"
                )

    def due(self) -> bool:
        return data_parallel.is_first() and super().due()

    def remove(self) -> None:
        if data_parallel.is_first():
            super().remove()

    def save(self, tensors: Mapping[str, Tensor], curves: dict[str, Any], controller: dict[str, Any]) -> None:
        """Save named tensors, the curves of `training.train` and the `state_dict` of a controller. ValueError if the
        file cannot be written."""
        if data_parallel.is_first():
            state = {name: value for name, value in controller.items() if name != "controller"}  # the row tells which
            self.write(_C.pack_state(tensors, curves, **state))  # type: ignore[arg-type]  # it takes bytes

    def found(self) -> Found:
        """Return what `restore` takes, the same in all processes: the files that are there, the last one first.
        ValueError if all of them are damaged."""
        return data_parallel.from_first(self.find)

    def restore(self, found: Found, load: Callable[[_C.Saved], None]) -> bool:  # type: ignore[override]
        """Call load(saved) with the tensors that were saved last, a `_C.Saved`. Where they are damaged, or load raises
        ValueError, warn and go on with those saved before. Return whether there were any. ValueError if all of them
        are refused."""
        there = super().restore(found, load)
        if self.notice and data_parallel.is_first():
            warnings.warn(self.notice, stacklevel=5)
        return there


def _settings_in(path: Path) -> dict[str, Any] | None:
    """What a checkpoint says it is of, in its second line; None where there is none that can be read."""
    try:
        with open(path, "rb") as file:
            file.readline()
            found = json.loads(file.readline())
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


_FINGERPRINTS = {"data": "the file of the data", "network": "the module of the network"}  # numbers that tell nobody


def difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The first setting in which two trainings differ, in words; of two scene files, their first line."""
    for name in dict.fromkeys([*here, *there]):
        old, new = there.get(name), here.get(name)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            return difference(old, new)
        if name in _FINGERPRINTS and old and new:
            return f"{_FINGERPRINTS[name]} has changed"
        if name == "text" and isinstance(old, str) and isinstance(new, str):
            lines = zip_longest(old.splitlines(), new.splitlines(), fillvalue="")
            old, new = next((pair for pair in lines if pair[0] != pair[1]), (old, new))
            name = "the scene file"
        return f"{name} was {str(old)!r:.80}, and is {str(new)!r:.80}"
    return "none"


def check_tensors(network: torch.nn.Module) -> None:
    """TypeError, naming the entry, for a network whose state_dict holds what a checkpoint cannot keep."""
    for name, value in network.state_dict().items():
        if not isinstance(value, torch.Tensor):
            raise TypeError(
                "train: the state_dict of network must hold tensors only, for its checkpoint, got "
                f"{type(value).__name__} for '{name}'"
            )


RANDOM, RANDOM_CUDA = "random", "random_cuda"
_CUDA_STATE = torch.zeros(16, dtype=torch.uint8)  # seed and offset


def random_states(device: torch.device) -> dict[str, Tensor]:
    """The states of the generators that a network on this device draws from, which `load_random` takes."""
    states = {RANDOM: torch.get_rng_state()}
    if device.type == "cuda":
        states[RANDOM_CUDA] = torch.cuda.get_rng_state(device)
    return states


def load_random(saved: _C.Saved, device: torch.device) -> None:
    """Take the states of the generators from a `_C.Saved`. That of a GPU is passed over on another device."""
    saved.restore(RANDOM, torch.default_generator)
    if saved.has(RANDOM_CUDA):
        state = saved.take(RANDOM_CUDA, _CUDA_STATE)
        if device.type == "cuda":
            torch.cuda.set_rng_state(state, device)


def make_optimiser(scene: _C.Scene, parameters: Iterable[Tensor]) -> torch.optim.Adam:
    """Adam as the scenes use it; in one kernel where torch has one, which takes no complex numbers."""
    trained = list(parameters)
    fused = scene.device.type in ("cpu", "cuda") and not any(p.is_complex() for p in trained)
    return torch.optim.Adam(trained, lr=scene.learning_rate(0), fused=fused)


def state_of(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The state of an Adam by names, which `load_optimiser` takes."""
    state = optimiser.state_dict()["state"]
    return {f"optimiser.{i}.{part}": value for i, parts in state.items() for part, value in parts.items()}


def load_optimiser(saved: _C.Saved, optimiser: torch.optim.Optimizer, updates: int) -> dict[int, dict[str, Tensor]]:
    """Take the state of an Adam after so many updates from a `_C.Saved`. A parameter may have had no gradient yet."""
    state = {}
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    for i, parameter in enumerate(parameters):
        if saved.has(f"optimiser.{i}.step"):
            state[i] = {
                "step": saved.take(f"optimiser.{i}.step", torch.zeros(()), 1, updates),
                "exp_avg": saved.take(f"optimiser.{i}.exp_avg", parameter),
                "exp_avg_sq": saved.take(f"optimiser.{i}.exp_avg_sq", parameter, 0),
            }
    optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
    return state
