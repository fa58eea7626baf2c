"""Checkpoints: the state of a running training, so that it can continue after it was killed."""

import io
import json
import pickle

import torch

from prdp_torch import _C


class Checkpoint(_C.Checkpoint):
    """The checkpoint file of one training.

    Args:
        path: the file. It is written to a temporary name first, so it is never half written.
        settings: everything that the training depends on. A file with other settings is ignored.
    """

    def __init__(self, path, **settings):
        super().__init__(path, json.dumps({"trainer": "Python", **settings}))

    def save(self, state):
        """Save a state made of tensors, state_dicts and plain values. ValueError if it cannot be written."""
        content = io.BytesIO()
        torch.save(state, content)
        self.write(content.getvalue())

    def load(self):
        """Return the state that was saved last, or None if there is none with these settings. ValueError if the file
        is damaged."""
        content = self.read()
        if content is None:
            return None
        try:
            return torch.load(io.BytesIO(content), weights_only=True)  # tensors and plain values; no code is run
        except (RuntimeError, EOFError, pickle.UnpicklingError):
            self.refuse()
