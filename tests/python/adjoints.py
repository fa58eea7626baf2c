"""What the tests of adjoints share: methods, matrices that suit them, and gradients with their report."""

import torch
from helpers import spd_matrices
from torch.autograd import grad

import prdp_torch as prdp

F64 = torch.float64
METHODS = {
    "jacobi": prdp.Jacobi,
    "steepest_descent": prdp.SteepestDescent,
    "cg": prdp.CG,
    "gmres": lambda k, rtol: prdp.GMRES(k, rtol=rtol, restart=2),
    "direct": prdp.Direct,
}


def matrices(method, n, batch, seed, dtype=F64):
    """Well conditioned, and symmetric where the method asks for it."""
    a = spd_matrices(batch, n, seed)
    if method not in ("cg", "steepest_descent"):
        a = a + 0.3 * torch.randn(a.shape, dtype=F64, generator=torch.Generator().manual_seed(seed + 1)).triu(1)
    return a.to(dtype)


def gradients(a, b, solver, g, create_graph=False, **options):
    """(A-bar, b-bar), u and the report."""
    a, b = a.detach().clone().requires_grad_(), b.detach().clone().requires_grad_()
    u, info = prdp.linear_solve(a, b, solver, **options)
    return grad(u, (a, b), g, create_graph=create_graph), u.detach(), info


def of_b_alone(a, b, solver, g, **options):
    b = b.detach().clone().requires_grad_()
    u, info = prdp.linear_solve(a, b, solver, **options)
    return grad(u, b, g)[0], info
