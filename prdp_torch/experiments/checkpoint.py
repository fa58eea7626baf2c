"""Checkpoints: the state of a running training, so that it can continue after it was killed."""

import io
import json
import pickle
import warnings

import torch

from prdp_torch import processes
from prdp_torch.experiments import _C

# What torch.load raises.
_DAMAGED = (RuntimeError, EOFError, pickle.UnpicklingError)


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

    def save(self, state):
        """Save a state made of tensors, state_dicts and plain values. ValueError if it cannot be written."""
        if not processes.is_first():
            return
        content = io.BytesIO()
        torch.save(state, content)
        self.write(content.getvalue())

    def load(self):
        """Return the state that was saved last, or None if there is none with these settings. If the file is damaged,
        warn and return the state before it. ValueError if there is none before it either."""
        content = processes.from_first(self.read)
        if content is None:
            state = None
        else:
            try:
                state = _unpacked(content)
            except _DAMAGED:
                state = self.load_before()
        if self.notice:
            warnings.warn(self.notice, stacklevel=3)
        return state

    def load_before(self):
        """Return the state before the one that `load` has returned, for a trainer that can make no sense of that;
        `notice` then says so. ValueError if there is none."""
        try:
            return _unpacked(processes.from_first(self.read_before))
        except _DAMAGED:
            self.refuse()


def _unpacked(content):
    return torch.load(io.BytesIO(content), weights_only=True)  # tensors and plain values; no code is run
