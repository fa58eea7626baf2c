"""Linear operators A on batches of vectors.

A vector is (batch, channel, *shape) for operators on grids, with one channel unless an operator says otherwise, and
(batch, n) for matrices. The tensors of an operator (nu, winds, a matrix) get gradients through `apply` and through
`linear_solve`.
"""

from prdp_torch.operators.base import Operator
from prdp_torch.operators.built_in import Burgers, Heat, NavierStokes, Poisson
from prdp_torch.operators.diffusion import Diffusion
from prdp_torch.operators.function import Function
from prdp_torch.operators.matrix import Matrix
from prdp_torch.operators.stencil import Stencil

__all__ = ["Burgers", "Diffusion", "Function", "Heat", "Matrix", "NavierStokes", "Operator", "Poisson", "Stencil"]
