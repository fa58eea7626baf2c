"""Progressively Refined Differentiable Physics for PyTorch.

Differentiable PDE steps whose linear solves may stop early, and a controller that decides how early:
`Heat`, `Poisson`, `Burgers`, `NavierStokes` and `linear_solve` solve, `ToleranceController` and
`PRDPController` refine. Tensors are (batch, channel, *shape); see the README for a first program and docs/
for the discretisation, the derivatives and what a solve says when it fails.
"""

import importlib
from typing import TYPE_CHECKING

from prdp_torch import _load

_load.load_library()

from prdp_torch import _C, fields, operators  # noqa: E402
from prdp_torch.advice import advise  # noqa: E402
from prdp_torch.advice_text import Advice  # noqa: E402
from prdp_torch.controller import LinearSchedule, PRDPController, ToleranceController  # noqa: E402
from prdp_torch.flow import Flow  # noqa: E402
from prdp_torch.gpu import warm_up  # noqa: E402
from prdp_torch.implicit_step import ImplicitStep  # noqa: E402
from prdp_torch.operator_check import check_operator  # noqa: E402
from prdp_torch.solve import SolveInfo, SolveStatus, detach_failed, linear_solve  # noqa: E402
from prdp_torch.solvers import (  # noqa: E402
    CG,
    GMRES,
    MINRES,
    BiCGStab,
    Chebyshev,
    Direct,
    Jacobi,
    Multigrid,
    Solver,
    SteepestDescent,
)
from prdp_torch.stepper import Stepper  # noqa: E402
from prdp_torch.steppers import Burgers, Heat, NavierStokes, Poisson  # noqa: E402

if TYPE_CHECKING:
    from prdp_torch import experiments
    from prdp_torch.experiments.trained import load_trained

__version__: str = _C.VERSION

__all__ = [
    "CG",
    "GMRES",
    "MINRES",
    "Advice",
    "BiCGStab",
    "Burgers",
    "Chebyshev",
    "Direct",
    "Flow",
    "Heat",
    "ImplicitStep",
    "Jacobi",
    "LinearSchedule",
    "Multigrid",
    "NavierStokes",
    "PRDPController",
    "Poisson",
    "SolveInfo",
    "SolveStatus",
    "Solver",
    "SteepestDescent",
    "Stepper",
    "ToleranceController",
    "advise",
    "check_operator",
    "detach_failed",
    "experiments",
    "fields",
    "linear_solve",
    "load_trained",
    "operators",
    "warm_up",
]


if not TYPE_CHECKING:  # which would take every misspelt name for one that is found here

    def __getattr__(name):
        """Import what only trainings need when it is first used."""
        if name == "experiments":
            return importlib.import_module("prdp_torch.experiments")
        if name == "load_trained":
            return importlib.import_module("prdp_torch.experiments.trained").load_trained
        raise AttributeError(f"module 'prdp_torch' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
