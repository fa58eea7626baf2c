"""The suite `accuracy` for a diffusion with a field of coefficients, whose gradient is wanted too."""

from benchmarks.accuracy import problem_points
from benchmarks.problems import DIFFUSION


def run(report, quick=False):
    """As `accuracy.run`; the gradient is that for b and for the field, its error the larger of the two."""
    problems = dict(list(DIFFUSION.items())[: 1 if quick else None])
    return {name: problem_points(make(), report, quick) for name, make in problems.items()}
