"""What a trained network is worth on the validation samples."""

import numpy as np
import torch

from prdp_torch import fields
from prdp_torch.experiments import _C
from prdp_torch.experiments.network_task import error, propagator


def spread(values):
    """Mean ± standard deviation, for a table; of a single value, the value."""
    deviation = f" ± {np.std(values, ddof=1):.0e}" if len(values) > 1 else ""
    return f"{np.mean(values):.2e}{deviation}"


def seeds_of(rows):
    """How many seeds a chart shows, in words."""
    count = len({row["seed"] for row in rows})
    return "one seed" if count == 1 else f"{count} seeds"


def validation_errors(scene, network):
    """(‖u - reference‖ / ‖reference‖)² of each validation sample after `valid_steps` steps, whose mean is the
    scene's metric."""
    data = _C.make_dataset(scene)
    with torch.no_grad():
        reached = fields.rollout(propagator(scene, network), data.valid_start, scene.data.valid_steps)[:, -1]
    return [error(scene, u, end) for u, end in zip(reached.split(1), data.valid_end.split(1), strict=True)]
