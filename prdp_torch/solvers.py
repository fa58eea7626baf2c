"""Solvers: which iteration, how many at most, to which tolerance.

All start from zero and stop, sample by sample, at the first of ‖b - A u‖ <= rtol ‖b‖ (the true
residual) or `max_iter` iterations; rtol = 0 runs exactly `max_iter`. Arguments out of range raise
ValueError.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch

from prdp_torch import _C


@dataclass
class Solver:
    """What every solver is: a method and its budget K = max_iter."""

    max_iter: int
    rtol: float = _C.DEFAULT_RTOL

    method: ClassVar[str]

    def __post_init__(self):
        if not torch.compiler.is_compiling():
            _C.check_solver(type(self).__name__, self.method, self.max_iter, self.rtol)


@dataclass
class Jacobi(Solver):
    """u ← D⁻¹(b - (L + U) u). Converges where the spectral radius of D⁻¹(L + U) is below 1."""

    method: ClassVar[str] = "jacobi"


@dataclass
class SteepestDescent(Solver):
    """α = r·r / r·Ar; u += α r; r -= α A r. Fits definite operators of either sign."""

    method: ClassVar[str] = "steepest_descent"


@dataclass
class CG(Solver):
    """Conjugate gradients (Hestenes and Stiefel 1952), for symmetric definite operators."""

    method: ClassVar[str] = "cg"


@dataclass
class Direct(Solver):
    """The cheapest exact method of the operator: Thomas in 1D, sine transform in 2D and 3D, LU for
    matrices. An iteration is one direct solve; those after the first refine its result."""

    max_iter: int = 1

    method: ClassVar[str] = "direct"
