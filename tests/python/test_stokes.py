"""GMRES preconditioned by a Navier-Stokes step without winds."""

import numpy as np
import pytest
import torch
from helpers import dense_navier_stokes, field

import prdp_torch as prdp
from prdp_torch import operators


def stokes(max_iter=40, restart=12, rtol=1e-12):
    return prdp.GMRES(max_iter, restart=restart, rtol=rtol, preconditioner="stokes")


def velocity(shape, speed, batch=2):
    return speed * field(shape, batch=batch, channels=2)


@pytest.mark.parametrize("shape", [(2, 3), (4, 4), (7, 5), (6, 9)], ids=str)
def test_without_winds_one_product_solves(shape):
    a = operators.NavierStokes(velocity(shape, 0.0), 1e-2, 0.1)
    b = prdp.fields.project(field(shape, channels=3))
    b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)
    for transposed in (False, True):
        rhs = a.apply_transpose(b) if transposed else a.apply(b)
        x = b.clone().requires_grad_()
        if transposed:
            u, info = prdp.linear_solve(a, x, stokes(1, restart=2))
            u.backward(rhs)
            u, info = x.grad, info.adjoint
        else:
            u, info = prdp.linear_solve(a, rhs, stokes(1, restart=2))
        assert (info.status > 0).all()
        np.testing.assert_allclose(u, b, atol=1e-11)


@pytest.mark.parametrize("shape", [(3, 4), (8, 5)], ids=str)
def test_with_winds_it_meets_the_minimum_norm_solution(shape):
    w = velocity(shape, 1.0)
    b = field(shape, channels=3, seed=1)
    b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)
    u, info = prdp.linear_solve(operators.NavierStokes(w, 1e-3, 0.1), b, stokes())
    assert (info.status > 0).all()
    for i in range(2):
        dense = dense_navier_stokes(w[i].numpy(), 1e-3, 0.1)
        expected = np.linalg.pinv(dense, rcond=1e-12) @ b[i].flatten().numpy()
        np.testing.assert_allclose(u[i].flatten(), expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_it_needs_far_fewer_products():
    state = prdp.fields.project(field((32, 32), channels=3) * 0.3)
    state[:, 2] = 0.0
    products = []
    for solver in (prdp.GMRES(200, restart=12), stokes(200, rtol=1e-5)):
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
        solver = prdp.GMRES(max_iter, restart=4, rtol=rtol, preconditioner="stokes")
        return prdp.NavierStokes((4, 5), nu, 0.1, solver=solver, backward=backward, on_failure="return")(u)

    assert torch.autograd.gradcheck(step, (u, nu))


def test_it_is_for_navier_stokes_alone():
    with pytest.raises(ValueError, match='preconditioner "stokes" is for NavierStokes operators alone'):
        prdp.Heat((5,), 1e-3, 1.0, solver=stokes())(field((5,)))
    with pytest.raises(ValueError, match="unknown preconditioner 'ilu'; allowed: None, 'diagonal', 'stokes'"):
        prdp.GMRES(3, preconditioner="ilu")
