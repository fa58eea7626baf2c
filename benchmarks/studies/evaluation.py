"""What a trained network is worth on the validation samples."""

import torch

from prdp_torch import _C, fields
from prdp_torch.training import propagator


def validation_errors(scene, network):
    """(‖u - reference‖ / ‖reference‖)² of each validation sample after `valid_steps` steps, whose mean is the
    scene's metric."""
    data = _C.make_dataset(scene)
    with torch.no_grad():
        reached = fields.rollout(propagator(scene, network), data.valid_start, scene.data.valid_steps)[:, -1]
    of = slice(0, 1) if scene.task == "corrector" else slice(None)
    difference = (reached - data.valid_end)[:, of].flatten(1).double()
    reference = data.valid_end[:, of].flatten(1).double()
    return (difference.square().sum(1) / reference.square().sum(1)).tolist()
