"""What the trainer needs of a task."""

from collections.abc import Callable
from typing import NamedTuple


class Task(NamedTuple):
    """What a task supplies."""

    updates: Callable  # the number of the first → an iterator over the losses of an interval's updates
    metric: Callable
    error: Callable  # the metric → the relative error of what is trained, as far as a user knows it
    state: Callable  # all that the updates change
    load: Callable  # its inverse
