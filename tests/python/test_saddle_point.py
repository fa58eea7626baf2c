"""GMRES for the Navier-Stokes step with a block preconditioner made of V-cycles."""

import numpy as np
import pytest
import torch
from helpers import dense_navier_stokes, field

import prdp_torch as prdp
from prdp_torch import operators


def multigrid(max_iter=40, restart=12, rtol=1e-12):
    return prdp.GMRES(max_iter, restart=restart, rtol=rtol, preconditioner="multigrid")


def right_hand_side(shape, seed=1):
    b = field(shape, channels=3, seed=seed)
    b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)
    return b


@pytest.mark.parametrize("shape", [(3, 4), (8, 5), (1, 6), (6, 1)], ids=str)
def test_it_meets_the_minimum_norm_solution_and_its_adjoint(shape):
    w = field(shape, batch=2, channels=2)
    b = right_hand_side(shape).requires_grad_()
    u, info = prdp.linear_solve(operators.NavierStokes(w, 1e-3, 0.1), b, multigrid(200))
    assert (info.status > 0).all()
    cotangent = right_hand_side(shape, seed=2)
    u.backward(cotangent)
    for i in range(2):
        dense = dense_navier_stokes(w[i].numpy(), 1e-3, 0.1)
        inverse = np.linalg.pinv(dense, rcond=1e-12)
        for found, rhs, matrix in ((u[i], b[i], inverse), (b.grad[i], cotangent[i], inverse.T)):
            expected = matrix @ rhs.detach().flatten().numpy()
            np.testing.assert_allclose(found.detach().flatten(), expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_it_needs_far_fewer_products():
    state = prdp.fields.project(field((32, 32), channels=3) * 0.3)
    state[:, 2] = 0.0
    products = []
    for solver in (prdp.GMRES(200, restart=12), multigrid(200, rtol=1e-5)):
        step = prdp.NavierStokes((32, 32), 1e-3, 0.02, solver=solver)
        step(state)
        assert step.converged
        products.append(step.info.operator_applications.double().mean())
    assert products[1] < 0.3 * products[0]


@pytest.mark.parametrize("backward, max_iter, rtol", [("implicit", 60, 1e-13), ("unrolled", 2, 0.0)])
def test_derivatives(backward, max_iter, rtol):
    u = prdp.fields.project(field((4, 5), channels=3)).requires_grad_()
    nu = torch.tensor(1e-2, dtype=torch.float64, requires_grad=True)

    def step(u, nu):
        solver = multigrid(max_iter, 4, rtol)
        return prdp.NavierStokes((4, 5), nu, 0.1, solver=solver, backward=backward, on_failure="return")(u)

    if backward == "implicit":
        assert torch.autograd.gradcheck(step, (u, nu))
        return
    # A preconditioner is a constant of the unrolled derivative, which is exact for b alone.
    a = operators.NavierStokes(u.detach()[:, :2], nu.detach(), 0.1)
    b = right_hand_side((4, 5)).requires_grad_()
    solve = lambda b: prdp.linear_solve(a, b, multigrid(max_iter, 4, rtol), backward, on_failure="return")[0]  # noqa: E731
    assert torch.autograd.gradcheck(solve, b)
