"""Trainings of scenes: data, networks, trainers, comparisons, charts and the command `prdp`.

`prdp_torch` itself does not need this package. The modules imported here need torch alone; the charts, reports and the
command line need `pip install prdp_torch[experiments]`.
"""

import importlib.util

from prdp_torch import _load

if importlib.util.find_spec("prdp_torch.experiments._C") is None:
    raise ImportError(
        "prdp_torch was built without its experiments, because the header toml++/toml.h was not found; install it, "
        f"for example with 'apt-get install libtomlplusplus-dev', and rebuild prdp_torch with {_load.REBUILD}"
    )

from prdp_torch.experiments import (
    checkpoint,
    datasets,
    networks,
    refinement,
    scenes,
    tensorboard,
    trained,
    training,
)

__all__ = ["checkpoint", "datasets", "networks", "refinement", "scenes", "tensorboard", "trained", "training"]
