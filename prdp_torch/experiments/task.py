"""What the trainer needs of a task."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from torch import Tensor

from prdp_torch.experiments import _C


class Task(NamedTuple):
    """What a task supplies."""

    # the number of the first → an iterator over an interval's updates: the loss, and the numbers of the samples among
    # the data where they have any
    updates: Callable[[int], Iterator[tuple[float, Tensor | None]]]
    metric: Callable[[], float]
    error: Callable[[float], float]  # the metric → the relative error of what is trained, as far as a user knows it
    state: Callable[[], dict[str, Tensor]]  # all that the updates change, as tensors by name
    load: Callable[
        [_C.Saved, int], None
    ]  # (these as a _C.Saved, the number of updates) →; ValueError where they are of another task
    updates_per_interval: int = 1
