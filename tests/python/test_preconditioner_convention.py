"""A preconditioner is applied as M⁻¹: one that resembles A, as other libraries take it, is told."""

import warnings

import pytest
import torch
from helpers import random

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
N = 16


def diffusion(contrast, seed):
    kappa = 1 + contrast * torch.rand(1, N, N, dtype=F64, generator=torch.Generator().manual_seed(seed))
    return operators.Diffusion(kappa, shift=1.0)


def of_matrix(m):
    return operators.Function(lambda r: (r.flatten(1) @ m.mT).view_as(r), lambda r: (r.flatten(1) @ m).view_as(r))


def dense(a):
    unit = torch.eye(N * N, dtype=F64).view(-1, 1, N, N)
    return a.apply(unit).flatten(1).mT


A = diffusion(3.0, seed=0)
DENSE = dense(A)
RESEMBLING = {
    "itself": A,
    "another κ": diffusion(1.0, seed=2),
    "a constant κ": diffusion(0.0, seed=0),
    "a multiple": of_matrix(-0.01 * DENSE),
    "its symmetric part": of_matrix(DENSE + 0.3 * torch.diag(DENSE.diagonal())),
}
DIAGONAL = DENSE.diagonal()
JACOBI = torch.eye(N * N, dtype=F64) - DENSE / DIAGONAL[:, None]
OTHERS = {
    "identity": operators.Function(lambda r: r.clone(), symmetric=True),
    "diagonal": of_matrix(torch.diag(1 / DIAGONAL)),
    "inverse": of_matrix(torch.linalg.inv(DENSE)),
    "inverse of another": of_matrix(torch.linalg.inv(dense(diffusion(0.0, seed=0)))),
    "Gauss-Seidel": of_matrix(torch.linalg.inv(torch.tril(DENSE))),
    "a sweep": of_matrix((torch.eye(N * N, dtype=F64) + JACOBI) / DIAGONAL),
    "four sweeps": of_matrix(sum(torch.linalg.matrix_power(JACOBI, k) for k in range(5)) / DIAGONAL),
}


def said_with(preconditioner, a=A, method=prdp.GMRES):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        prdp.linear_solve(a, random(2, 1, N, N, seed=3), method(20, preconditioner=preconditioner))
    return [str(w.message) for w in caught if "resembles A" in str(w.message)]


@pytest.mark.parametrize("name", RESEMBLING)
def test_one_that_resembles_a_is_told(name, always):
    (said,) = said_with(RESEMBLING[name])
    assert "should resemble the inverse of A" in said


@pytest.mark.parametrize("name", OTHERS)
def test_others_are_not(name, always):
    assert not said_with(OTHERS[name])


def test_where_a_is_nearly_the_identity_its_inverse_is_too(always):
    near = operators.Diffusion(torch.full((1, N, N), 1e-5, dtype=F64), shift=1.0)
    assert not said_with(near, near, prdp.CG)


def test_no_one_else_is_asked_and_it_is_said_once():
    assert not said_with("diagonal", method=prdp.CG) and not said_with("multigrid", method=prdp.CG)
    counted = [len(said_with(A, method=prdp.BiCGStab)) for _ in range(4)]
    assert counted == [1, 0, 0, 0]
