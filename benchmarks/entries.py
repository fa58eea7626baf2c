"""What is timed: ways to solve a problem, ours and others'."""

from typing import NamedTuple


class Entry(NamedTuple):
    """A way to solve a problem. `prepare(k)` gives two callables: the solution, and (solution, gradient),
    finished when they return."""

    label: str
    mode: str  # "implicit" or "unrolled"
    ks: list  # budgets to run; [None] where there is none to choose
    prepare: callable
    applications: callable = None  # (forward, both) products with A of a run with K
    same_as: str | None = None  # the method of ours that runs the same iteration with the same K
