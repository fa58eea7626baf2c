"""Checkpoints: the state of a running training, so that it can continue after it was killed."""

import json
import warnings

import torch

from prdp_torch import processes
from prdp_torch.experiments import _C


class Checkpoint(_C.Checkpoint):
    """The checkpoint file of one training.

    Args:
        path: the file. It is written to a temporary name first, so it is never half written.
        settings: everything that the training depends on. A file with other settings is ignored.
    """

    def __init__(self, path, **settings):
        super().__init__(path, json.dumps({"trainer": "Python", **settings}))

    def due(self):
        return processes.is_first() and super().due()

    def remove(self):
        if processes.is_first():
            super().remove()

    def save(self, tensors, curves, controller):
        """Save named tensors, the curves of `training.train` and the `state_dict` of a controller. ValueError if the
        file cannot be written."""
        if processes.is_first():
            self.write(_C.pack_state(tensors, curves, **controller))

    def found(self):
        """Return what `restore` takes, the same in all processes: the files that are there, the last one first.
        ValueError if all of them are damaged."""
        return processes.from_first(self.find)

    def restore(self, found, load):
        """Call load(saved) with the tensors that were saved last, a `_C.Saved`. Where they are damaged, or load raises
        ValueError, warn and go on with those saved before. Return whether there were any. ValueError if all of them
        are refused."""
        there = super().restore(found, load)
        if self.notice and processes.is_first():
            warnings.warn(self.notice, stacklevel=5)
        return there


def check_tensors(network):
    """TypeError, naming the entry, for a network whose state_dict holds what a checkpoint cannot keep."""
    for name, value in network.state_dict().items():
        if not isinstance(value, torch.Tensor):
            raise TypeError(
                "train: the state_dict of network must hold tensors only, for its checkpoint, got "
                f"{type(value).__name__} for '{name}'"
            )


def state_of(optimiser):
    """The state of an Adam by names, which `load_optimiser` takes."""
    state = optimiser.state_dict()["state"]
    return {f"optimiser.{i}.{part}": value for i, parts in state.items() for part, value in parts.items()}


def load_optimiser(saved, optimiser, updates):
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
