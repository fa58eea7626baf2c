"""What the tests of starts share: the methods for symmetric systems and for others."""

import prdp_torch as prdp

SYMMETRIC = [prdp.Jacobi, prdp.Chebyshev, prdp.SteepestDescent, prdp.CG, prdp.GMRES]
GENERAL = [prdp.Jacobi, prdp.SteepestDescent, prdp.GMRES]
