"""What the trainer needs of a task."""

from collections.abc import Callable
from typing import NamedTuple


class Task(NamedTuple):
    """What a task supplies."""

    # the number of the first → an iterator over an interval's updates: the loss, and the numbers of the samples among
    # the data where they have any
    updates: Callable
    metric: Callable
    error: Callable  # the metric → the relative error of what is trained, as far as a user knows it
    state: Callable  # all that the updates change, as tensors by name
    load: Callable  # (these as a _C.Saved, the number of updates) →; ValueError where they are of another task
    updates_per_interval: int = 1
