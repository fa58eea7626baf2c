"""Trainings of scenes: data, networks, trainers, comparisons, charts and the command `prdp`.

`prdp_torch` itself does not need this package. The modules imported here need torch alone; the charts, reports and the
command line need `pip install prdp_torch[experiments]`.
"""

from prdp_torch.experiments import checkpoint, datasets, networks, refinement, scenes, tensorboard, trained, training

__all__ = ["checkpoint", "datasets", "networks", "refinement", "scenes", "tensorboard", "trained", "training"]
