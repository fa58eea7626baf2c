"""Preconditioners that autograd cannot look into: of numpy, as factorisations by SciPy are."""

import numpy as np
import pytest
import torch
from helpers import dense_heat, random

import prdp_torch as prdp
from prdp_torch import operators

N = 24
A = torch.from_numpy(dense_heat((N,), 1e-2))
INVERSE = np.linalg.inv(A.numpy() + 0.05 * np.diag(np.linspace(1, 2, N)))
SKEWED = INVERSE @ (np.eye(N) + 0.1 * np.eye(N, k=1))


def by_numpy(matrix):
    return lambda r: torch.from_numpy(r.numpy() @ matrix.T)


PRECONDITIONERS = {
    "symmetric": (prdp.CG, lambda: operators.Function(by_numpy(INVERSE), symmetric=True)),
    "with a transpose": (prdp.BiCGStab, lambda: operators.Function(by_numpy(SKEWED), by_numpy(SKEWED.T))),
    "of restarts": (prdp.GMRES, lambda: operators.Function(by_numpy(SKEWED), by_numpy(SKEWED.T))),
}


@pytest.mark.parametrize("name", PRECONDITIONERS)
def test_unrolled_gradients_are_those_of_differences(name):
    method, make = PRECONDITIONERS[name]
    solver = method(3, rtol=0.0, preconditioner=make())
    b, direction, weights = random(3, 2, N, seed=1)

    def loss(b):
        return (prdp.linear_solve(A, b, solver, backward="unrolled")[0] * weights).sum()

    leaf = b.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss(leaf), leaf)
    differences = (loss(b + 1e-6 * direction) - loss(b - 1e-6 * direction)) / 2e-6
    torch.testing.assert_close((found * direction).sum(), differences, rtol=1e-6, atol=0)


def test_without_a_transpose_it_is_refused_where_it_would_be_differentiated():
    hidden = operators.Function(lambda r: torch.from_numpy(r.detach().numpy() @ SKEWED.T))
    b = random(2, N, seed=1).requires_grad_()
    solver = prdp.GMRES(2, rtol=0.0, restart=3, preconditioner=hidden)
    with pytest.raises(
        ValueError, match=r"preconditioner: autograd does not see .* give its transpose, or say that it"
    ):
        prdp.linear_solve(A, b, solver, backward="unrolled")[0].sum().backward()


def test_a_learned_one_is_said_to_be_a_constant(always):
    weight = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    learned = operators.Function(lambda r, w: r + w * r, tensors=weight, symmetric=True)
    b = random(2, N, seed=1).requires_grad_()
    with pytest.warns(UserWarning, match="the tensors of the preconditioner require grad and get none"):
        u, _ = prdp.linear_solve(A, b, prdp.CG(3, 0.0, preconditioner=learned), backward="unrolled")
    u.sum().backward()
    assert weight.grad is None
