"""What the tests share: independent truths, golden arrays and tables of cases."""

from pathlib import Path

import numpy as np
import torch

import prdp_torch as prdp

DATA = Path(__file__).parents[1] / "data"
ITERATIVE = [prdp.Jacobi, prdp.SteepestDescent, prdp.CG, prdp.GMRES]
SOLVERS = [*ITERATIVE, prdp.Direct]


def golden(name):
    return np.load(DATA / f"{name}.npz")


def statuses(info):
    return [prdp.SolveStatus(int(s)).name for s in info.status]


def field(shape, batch=2, seed=0, dtype=torch.float64):
    """Random (batch, 1, *shape)."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, 1, *shape, generator=generator, dtype=dtype)


def dense_laplacian(shape):
    """The Dirichlet Laplacian as a matrix, by Kronecker sums of 1D matrices in numpy."""
    total = np.zeros((1, 1))
    for n in shape:
        second = (np.diag(np.full(n, -2.0)) + np.eye(n, k=1) + np.eye(n, k=-1)) * (n + 1) ** 2
        total = np.kron(total, np.eye(n)) + np.kron(np.eye(len(total)), second)
    return total


def dense_heat(shape, nu=1e-3, dt=1.0):
    laplacian = dense_laplacian(shape)
    return np.eye(len(laplacian)) - nu * dt * laplacian


def spd_matrices(batch, n, seed=0, dtype=torch.float64):
    """Random well-conditioned symmetric positive definite matrices (batch, n, n), diagonally dominant."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(batch, n, n, generator=generator, dtype=dtype)
    a = 0.5 * (a + a.mT)
    return a + 1.5 * torch.diag_embed(a.abs().sum(-1))
