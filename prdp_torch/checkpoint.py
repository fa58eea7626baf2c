"""Checkpoints: a training kept while it runs, so that a killed one goes on from its last interval."""

import io
import json
import pickle
import warnings

import torch

from prdp_torch import _C, processes


class Checkpoint(_C.Checkpoint):
    """The file of one training. csrc/prdp/scenes/checkpoint.h says when one is due and what makes it valid. Of several
    processes that train together the first one writes and reads it.

    Args:
        path: of the file; it is written to a temporary name first.
        settings: all that the training depends on; a file of other settings is not read.
    """

    def __init__(self, path, **settings):
        super().__init__(path, json.dumps({"trainer": "Python", **settings}))

    def due(self):
        return processes.is_first() and super().due()

    def remove(self):
        if processes.is_first():
            super().remove()

    def save(self, state):
        """Replace the file by this state: tensors, state_dicts and plain values. ValueError if it cannot be written."""
        if not processes.is_first():
            return
        content = io.BytesIO()
        torch.save(state, content)
        self.write(content.getvalue())

    def load(self):
        """The state last saved, None where there is none of these settings. Where the last one is damaged, a warning,
        and the one before; ValueError where there is none before it."""
        content = processes.from_first(self.read)
        if self.notice:
            warnings.warn(self.notice, stacklevel=3)
        if content is None:
            return None
        try:
            return torch.load(io.BytesIO(content), weights_only=True)  # tensors and plain values; no code is run
        except (RuntimeError, EOFError, pickle.UnpicklingError):
            self.refuse()
