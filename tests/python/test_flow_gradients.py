"""Derivatives of Burgers and Navier-Stokes solves and steps, in float64: the winds are the state."""

import numpy as np
import pytest
import torch
from helpers import dense_burgers, field, golden, modes
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp
from prdp_torch import operators

DIRECT, JACOBI = prdp.Direct(), prdp.Jacobi(400, rtol=1e-14)
# name: (stepper, its operator, grid, channels, solver)
CASES = {
    "burgers_1d_direct": (prdp.Burgers, operators.Burgers, (5,), 1, DIRECT),
    "burgers_1d_jacobi": (prdp.Burgers, operators.Burgers, (5,), 1, JACOBI),
    "burgers_2d_direct": (prdp.Burgers, operators.Burgers, (3, 2), 2, DIRECT),
    "burgers_2d_jacobi": (prdp.Burgers, operators.Burgers, (3, 2), 2, JACOBI),
    "navier_stokes_direct": (prdp.NavierStokes, operators.NavierStokes, (3, 2), 3, DIRECT),
}
cases = pytest.mark.parametrize("name", CASES)


def viscosity():
    return torch.tensor(2e-2, dtype=torch.float64, requires_grad=True)


@cases
@modes
@pytest.mark.parametrize("batch", [1, 2])
def test_converged_solves_differentiate_right_hand_side_winds_and_viscosity(name, backward, batch):
    _, operator, shape, channels, solver = CASES[name]
    b = field(shape, channels=channels).requires_grad_()
    winds = field(shape, batch, seed=3, channels=channels).requires_grad_()

    def solve(b, winds, nu):
        # Navier-Stokes solves what is consistent of any b and of any cotangent, and its status tells.
        return prdp.linear_solve(operator(winds, nu, 0.2), b, solver, backward=backward, on_failure="return")[0]

    inputs = b, winds, viscosity()
    assert gradcheck(solve, inputs)
    assert gradgradcheck(solve, inputs, fast_mode=True)


@cases
@modes
def test_steps_differentiate_state_and_viscosity(name, backward):
    stepper, _, shape, channels, solver = CASES[name]
    u = field(shape, channels=channels).requires_grad_()

    def two_steps(u, nu):
        step = stepper(shape, nu, 0.2, solver=solver, backward=backward, on_failure="return")
        return step(step(u))

    assert gradcheck(two_steps, (u, viscosity()))
    assert gradgradcheck(two_steps, (u, viscosity()), fast_mode=True)


@pytest.mark.parametrize("solver", [prdp.Jacobi, prdp.SteepestDescent])
@pytest.mark.parametrize("k", [1, 2, 5])
def test_unrolled_is_the_exact_derivative_of_k_iterations(solver, k):
    u = field((6,)).requires_grad_()

    def step(u, nu):
        return prdp.Burgers((6,), nu, 0.2, solver=solver(k, rtol=0.0), backward="unrolled")(u)

    assert gradcheck(step, (u, viscosity()))
    assert gradgradcheck(step, (u, viscosity()), fast_mode=True)


def test_implicit_is_the_truncated_adjoint_solve_with_the_product_rule():
    nu, dt, k = 2e-2, 0.2, 3
    winds, b, g = (field((7,), seed=s) for s in range(3))
    winds.requires_grad_()
    u, _ = prdp.linear_solve(operators.Burgers(winds, nu, dt), b, prdp.Jacobi(k, rtol=0.0))
    u.backward(g)
    for i in range(2):
        a = dense_burgers(winds[i].detach().numpy(), nu, dt)
        adjoint = np.zeros(7)
        for _ in range(k):
            adjoint += (g[i].flatten().numpy() - a.T @ adjoint) / np.diag(a)
        for j in range(7):
            step = np.zeros((1, 7))
            step[0, j] = 1e-6
            w = winds[i].detach().numpy()
            slope = (dense_burgers(w + step, nu, dt) - dense_burgers(w - step, nu, dt)) / 2e-6
            expected = -adjoint @ slope @ u[i].detach().flatten().numpy()
            assert float(winds.grad[i, 0, j]) == pytest.approx(expected, rel=1e-6, abs=1e-8)


@modes
def test_a_burgers_step_and_its_gradient_equal_the_published_code(backward):
    g = golden("burgers1d")
    for solver in (prdp.Direct(), prdp.Jacobi(2000, rtol=1e-12)):
        u = torch.tensor(g["u"])[:, None].requires_grad_()
        u_next = prdp.Burgers((256,), 1e-3, 0.01, solver=solver, backward=backward)(u)
        u_next.backward(torch.tensor(g["w"])[:, None])
        np.testing.assert_allclose(u_next.detach()[:, 0], g["direct"], rtol=0, atol=1e-10)
        np.testing.assert_allclose(u.grad[:, 0], g["grad"], rtol=0, atol=1e-10)


@modes
def test_a_navier_stokes_step_and_its_gradient_equal_an_independent_implementation(backward):
    g = golden("ns10")
    u = torch.tensor(g["u_prev"]).requires_grad_()
    step = prdp.NavierStokes((10, 10), 1e-4, 0.1, solver=prdp.Direct(rtol=1e-12), backward=backward)
    u_next = step(u)
    u_next.backward(torch.tensor(g["w"]))
    np.testing.assert_allclose(u_next.detach(), g["step"], rtol=0, atol=1e-11)
    np.testing.assert_allclose(u.grad, g["grad"], rtol=0, atol=1e-6)
    assert step.converged and not u.grad[:, 2].any()


def test_both_modes_and_both_solvers_agree_on_a_rollout_in_float32():
    gradients = []
    for dtype, solver in ((torch.float64, prdp.Direct()), (torch.float32, prdp.Jacobi(300, rtol=1e-6))):
        for backward in ("implicit", "unrolled"):
            u = field((5, 6), dtype=torch.float64, channels=2).to(dtype).requires_grad_()
            step = prdp.Burgers((5, 6), 1e-2, 0.1, solver=solver, backward=backward)
            (step(step(u)) ** 2).sum().backward()
            gradients.append(u.grad.double())
    for other in gradients[1:]:
        torch.testing.assert_close(other, gradients[0], rtol=1e-4, atol=1e-5)


@cases
@modes
def test_picard_steps_differentiate_and_count_every_solve(name, backward):
    stepper, _, shape, channels, solver = CASES[name]

    def step(u, nu, steps=2):
        physics = stepper(shape, nu, 0.1, solver, backward, picard_steps=steps, on_failure="return")
        return physics(u), physics.info

    u = field(shape, channels=channels).requires_grad_()
    assert gradcheck(lambda u, nu: step(u, nu)[0], (u, viscosity()))
    once, twice = (step(u, 2e-2, steps)[1] for steps in (1, 2))
    assert (twice.iterations > once.iterations).all()
    assert (twice.operator_applications > once.operator_applications).all()


def test_picard_steps_converge_to_the_fully_implicit_step():
    u = field((12,))
    changes = []
    for steps in (1, 2, 4, 16):
        physics = prdp.Burgers((12,), 1e-2, 0.02, solver=prdp.Direct(), picard_steps=steps)
        u_next = physics(u)
        changes.append(float((physics.operator(u_next).apply(u_next) - u).norm() / u.norm()))
    assert changes[0] > 1e-2 and changes[1] < changes[0] and changes[2] < changes[1] and changes[3] < 1e-9
    with pytest.raises(ValueError, match="Burgers: picard_steps must be >= 1, got 0"):
        prdp.Burgers((12,), 1e-2, 0.02, solver=prdp.Direct(), picard_steps=0)


def test_winds_without_gradient_leave_the_gradient_of_the_right_hand_side():
    a = operators.Burgers(field((9,), batch=1), 1e-2, 0.1)
    b, g = field((9,), seed=1).requires_grad_(), field((9,), seed=2)
    prdp.linear_solve(a, b, prdp.Direct())[0].backward(g)
    expected = torch.linalg.solve(a.dense().mT, g[:, 0].mT).mT
    torch.testing.assert_close(b.grad[:, 0], expected)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: prdp.Burgers((8,), -1.0, 0.1, DIRECT), "Burgers: nu must be finite and >= 0, got -1"),
        (lambda: prdp.Burgers((8,), 1e-3, 0.0, DIRECT), "Burgers: dt must be finite and > 0, got 0"),
        (lambda: prdp.Burgers((4, 4, 4), 1e-3, 0.1, DIRECT), "Burgers: shape must have 1 or 2 extents"),
        (lambda: prdp.Burgers((-3,), 1e-3, 0.1, DIRECT), "Burgers: every extent of shape must be >= 2"),
        (lambda: prdp.NavierStokes((8,), 1e-3, 0.1, DIRECT), "NavierStokes: shape must have 2 extents"),
        (lambda: prdp.NavierStokes((8, 8), 1e-3, float("inf"), DIRECT), "NavierStokes: dt must be finite and > 0"),
        (lambda: prdp.Burgers((256,), 1e-3, 0.1, DIRECT)(torch.zeros(25, 256)),
         r"Burgers: expected \(batch, 1, 256\), got \(25, 256\)"),
        (lambda: prdp.Burgers((4, 4), 1e-3, 0.1, DIRECT)(field((4, 4))), r"expected \(batch, 2, 4, 4\), got \(2, 1"),
        (lambda: prdp.NavierStokes((4, 4), 1e-3, 0.1, DIRECT)(field((4, 4), channels=2)),
         r"NavierStokes: expected \(batch, 3, 4, 4\), got \(2, 2, 4, 4\)"),
    ],
)  # fmt: skip
def test_steppers_say_what_is_wrong(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_steppers_say_which_type_is_wrong():
    with pytest.raises(TypeError, match=r"Burgers: picard_steps must be a whole number, got 1\.5"):
        prdp.Burgers((8,), 1e-3, 0.1, DIRECT, picard_steps=1.5)
    with pytest.raises(TypeError, match="NavierStokes: dt must be a real number, got None"):
        prdp.NavierStokes((8, 8), 1e-3, None, DIRECT)
