"""GMRES on Burgers and Navier-Stokes: the published iterates, gradients at every scale, the null space."""

import numpy as np
import pytest
import torch
from helpers import field, golden, statuses

import prdp_torch as prdp
from prdp_torch import _C, operators
from prdp_torch.solvers import packed_options

BURGERS, FLOW = golden("burgers1d"), golden("ns10")
BURGERS_U = torch.tensor(BURGERS["u"]).view(3, 1, 256)
FLOW_U = torch.tensor(FLOW["u_prev"])


def burgers(solver, **options):
    return prdp.Burgers((256,), 1e-3, 1e-2, solver=solver, **options)


def navier_stokes(solver, **options):
    return prdp.NavierStokes((10, 10), 1e-4, 0.1, solver=solver, **options)


def consistent(shape, seed=0, batch=2, dtype=torch.float64):
    """A right-hand side of Navier-Stokes without a mean pressure."""
    b = field(shape, channels=3, seed=seed, batch=batch)
    b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)
    return b.to(dtype)


@pytest.mark.parametrize("k", [1, 4, 16])
def test_burgers_iterates_and_adjoint_equal_the_published_ones(k):
    step = burgers(prdp.GMRES(k, restart=2, rtol=0.0))
    np.testing.assert_allclose(step(BURGERS_U).flatten(1), BURGERS[f"gmres2_K{k}_tol0"], atol=1e-8)
    assert step.info.operator_applications.tolist() == [3 * k] * 3


def test_burgers_stops_where_the_published_code_stops():
    step = burgers(prdp.GMRES(60, restart=2))
    np.testing.assert_allclose(step(BURGERS_U).flatten(1), BURGERS["gmres2_K60_tol1e5"], atol=1e-8)
    assert step.converged and step.info.iterations.max() <= 25


@pytest.mark.parametrize("k", [1, 4])
def test_navier_stokes_iterates_equal_the_dense_ones(k):
    step = navier_stokes(prdp.GMRES(k, restart=8, rtol=0.0))
    np.testing.assert_allclose(step(FLOW_U), FLOW[f"gmres8_K{k}"], atol=1e-8)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_converged_steps_and_gradients(backward):
    cases = (
        (burgers(prdp.GMRES(300, restart=10, rtol=1e-12), backward=backward), BURGERS_U, BURGERS, "direct", 1e-9),
        (navier_stokes(prdp.GMRES(300, restart=20, rtol=1e-12), backward=backward), FLOW_U, FLOW, "step", 1e-9),
    )
    for step, start, g, name, close in cases:
        u = start.clone().requires_grad_()
        result = step(u)
        np.testing.assert_allclose(result.detach(), torch.tensor(g[name]).view_as(u), rtol=0, atol=close)
        result.backward(torch.tensor(g["w"]).view_as(u))
        expected = torch.tensor(g["grad"]).view_as(u)
        np.testing.assert_allclose(u.grad, expected, rtol=0, atol=1e-6 * expected.abs().max())


@pytest.mark.parametrize(
    "make, start", [(burgers, BURGERS_U), (navier_stokes, FLOW_U)], ids=["burgers", "navier_stokes"]
)
def test_the_gradient_scales_with_the_loss(make, start):
    """An adjoint with the primal's absolute tolerance would return 0 for a small loss."""
    step, gradients = make(prdp.GMRES(60, restart=4)), {}
    for power in (-40, 0, 40):
        u = start.clone().requires_grad_()
        (2.0**power * step(u)[:, :1].square().sum()).backward()
        gradients[power] = u.grad
    assert gradients[0].abs().max() > 0
    for power in (-40, 40):
        assert torch.equal(gradients[power], 2.0**power * gradients[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("transposed", [False, True])
def test_the_cpu_loops_equal_the_plain_tensors(dtype, transposed):
    nu = torch.tensor(1e-3, dtype=torch.float64)
    cases = (
        ("burgers", [19], field((19,), dtype=dtype), field((19,), seed=1, dtype=dtype)),
        ("burgers", [5, 18], field((5, 18), channels=2, dtype=dtype), field((5, 18), channels=2, seed=1, dtype=dtype)),
        ("navier_stokes", [7, 17], field((7, 17), channels=2, dtype=dtype), consistent((7, 17), seed=1, dtype=dtype)),
    )
    for kind, shape, winds, b in cases:
        system, solver = ([winds, nu], kind, shape, [0.1], transposed), ("gmres", 3, 0.0, 4)
        options = packed_options(*solver, None, "none")
        u, iterations, _, _, applications, _ = torch.ops.prdp.linear_solve(b, *system, None, *options)
        v, report = _C.solve_with_tensors(b, *system, *solver)
        np.testing.assert_allclose(u, v, rtol=0, atol=200 * torch.finfo(dtype).eps * v.abs().max())
        assert iterations.tolist() == report[0].tolist() and applications.tolist() == report[3].tolist()


def test_48_by_48_takes_as_many_cycles_as_the_published_code():
    start = prdp.fields.project(smooth_noise(48, batch=4).float())
    step = prdp.NavierStokes((48, 48), 1e-4, 0.1, solver=prdp.GMRES(120, restart=8))
    step(start)
    assert step.converged and 33 <= step.info.iterations.double().mean() <= 46
    assert prdp.fields.divergence(step(start)).abs().max() < 1e-2  # rtol 1e-5 of velocities over dt


def smooth_noise(n, batch):
    """Low-pass filtered white noise with standard deviation 1, no pressure."""
    noise = field((n, n), channels=3, batch=batch)
    k = torch.fft.fftfreq(n, 1 / n, dtype=torch.float64) * 2 * torch.pi
    smooth = torch.fft.ifft2(torch.fft.fft2(noise) / (1 + 3e-3 * (k[:, None] ** 2 + k**2))).real
    smooth = (smooth - smooth.mean((-2, -1), keepdim=True)) / smooth.std((-2, -1), keepdim=True)
    smooth[:, 2] = 0.0
    return smooth


@pytest.mark.parametrize("solver", [prdp.GMRES(200, restart=20), prdp.Direct()], ids=["gmres", "direct"])
def test_a_mean_pressure_on_the_right_is_inconsistent(solver):
    a = operators.NavierStokes(FLOW_U, 1e-4, 0.1)
    b = consistent((10, 10), batch=3)
    expected, _ = prdp.linear_solve(a, b, solver)
    b[1, 2] += 0.5
    b[2, 2] += 1e-15  # rounding
    u, info = prdp.linear_solve(a, b, solver, on_failure="return")
    assert statuses(info)[1] == "INCONSISTENT" and (info.status[[0, 2]] > 0).all()
    np.testing.assert_allclose(u, expected, atol=1e-3)  # of the consistent part
    assert u[:, 2].mean((-2, -1)).abs().max() < 1e-12
    with pytest.raises(torch.linalg.LinAlgError, match="1 of 3 samples failed: sample 1 INCONSISTENT"):
        prdp.linear_solve(a, b, solver)


def test_a_right_hand_side_of_nothing_but_mean_pressure_gives_zeros():
    b = torch.zeros(1, 3, 10, 10, dtype=torch.float64)
    b[:, 2] = 1.0
    u, info = prdp.linear_solve(
        operators.NavierStokes(FLOW_U[:1], 1e-4, 0.1), b, prdp.GMRES(5, restart=4), on_failure="return"
    )
    assert statuses(info) == ["INCONSISTENT"] and torch.equal(u, torch.zeros_like(u))


def test_an_inconsistent_cotangent_is_reported():
    u = FLOW_U.clone().requires_grad_()
    step = navier_stokes(prdp.GMRES(60, restart=20))
    with pytest.raises(torch.linalg.LinAlgError, match=r"adjoint solve: .* INCONSISTENT"):
        step(u)[:, 2].sum().backward()


def test_jacobi_says_that_the_pressure_has_no_diagonal():
    step = navier_stokes(prdp.Jacobi(5), on_failure="return")
    step(FLOW_U)
    assert statuses(step.info) == ["ZERO_DIAGONAL"] * 3
