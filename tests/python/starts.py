"""What the tests of starts share: both modes, and the methods for symmetric systems and for others."""

import pytest

import prdp_torch as prdp

modes = pytest.mark.parametrize("backward", ["implicit", "unrolled"])
SYMMETRIC = [prdp.Jacobi, prdp.Chebyshev, prdp.SteepestDescent, prdp.CG, prdp.GMRES]
GENERAL = [prdp.Jacobi, prdp.SteepestDescent, prdp.GMRES]
