"""Laws of the discrete Burgers and Navier-Stokes steps, and their convergence."""

import math

import numpy as np
import pytest
import torch
from helpers import field

import prdp_torch as prdp
from prdp_torch import fields, operators

DIRECT = prdp.Direct(rtol=1e-12)
BURGERS_GRIDS = [(17,), (2,), (6, 9)]


def burgers(shape, nu=1e-2, dt=0.05):
    return prdp.Burgers(shape, nu, dt, solver=DIRECT)


def navier_stokes(shape, nu=1e-2, dt=0.05):
    return prdp.NavierStokes(shape, nu, dt, solver=DIRECT)


def close(a, b):
    torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-11)


def constant(shape, *values):
    return torch.tensor(values, dtype=torch.float64).view(1, -1, *[1] * len(shape)).expand(2, -1, *shape)


@pytest.mark.parametrize("shape", BURGERS_GRIDS)
def test_a_constant_state_stays(shape):
    u = constant(shape, *(0.7, -1.3)[: len(shape)])
    close(burgers(shape)(u), u)
    if len(shape) == 2:
        close(navier_stokes(shape)(constant(shape, 0.7, -1.3, 0.0)), constant(shape, 0.7, -1.3, 0.0))


@pytest.mark.parametrize("solver", [DIRECT, prdp.Jacobi(500, rtol=1e-13)])
@pytest.mark.parametrize("shape", [(33,), (8, 7)])
def test_burgers_obeys_the_maximum_principle_at_any_time_step(solver, shape):
    u = 5 * field(shape, batch=4, channels=len(shape))
    for dt in (1e-3, 0.1, 1.0):
        step = prdp.Burgers(shape, 1e-3, dt, solver=solver, on_failure="return")
        u_next = step(u)
        assert step.converged or (solver is not DIRECT and dt > 1e-3)
        if not step.converged:
            continue
        axes = tuple(range(2, u.dim()))
        assert (u_next.amax(axes) <= u.amax(axes) + 1e-11).all() and (u_next.amin(axes) >= u.amin(axes) - 1e-11).all()


@pytest.mark.parametrize("make, channels", [(burgers, 2), (navier_stokes, 3)])
def test_shifts_by_whole_cells_commute_with_a_step(make, channels):
    step, u = make((6, 9)), field((6, 9), channels=channels)
    for shifts in ((1, 0), (0, 1), (4, -3)):
        close(step(u.roll(shifts, (2, 3))), step(u).roll(shifts, (2, 3)))


def test_a_reflection_commutes_with_a_burgers_step():
    u = field((17,))
    close(burgers((17,))(-u.flip(2)), -burgers((17,))(u).flip(2))
    u, sign = field((6, 9), channels=2), torch.tensor([-1.0, 1.0]).view(2, 1, 1)
    step = burgers((6, 9))
    close(step(sign * u.flip(3)), sign * step(u).flip(3))
    close(step(-sign * u.flip(2)), -sign * step(u).flip(2))


def test_a_reflection_commutes_with_a_navier_stokes_step():
    """Mirrored, the left face of a cell is the right one: u₁ moves on by a cell."""

    def mirrored(u):
        u1, u2, p = u.flip(3).unbind(1)
        return torch.stack([-u1.roll(1, 2), u2, p], dim=1)

    step, u = navier_stokes((6, 9)), field((6, 9), channels=3)
    close(step(mirrored(u)), mirrored(step(u)))


@pytest.mark.parametrize("make, order", [(burgers, [1, 0]), (navier_stokes, [1, 0, 2])])
def test_swapped_axes_and_components_commute_with_a_step(make, order):
    u = field((6, 9), channels=len(order))
    close(make((9, 6))(u.transpose(2, 3)[:, order]), make((6, 9))(u).transpose(2, 3)[:, order])


def test_burgers_in_two_dimensions_contains_the_one_dimensional_one():
    u = field((9,))
    along_x = torch.stack([u.expand(2, 6, 9), torch.zeros(2, 6, 9, dtype=u.dtype)], dim=1)
    close(burgers((6, 9))(along_x)[:, 0], burgers((9,))(u).expand(2, 6, 9))
    along_y = along_x.transpose(2, 3).flip(1)
    close(burgers((9, 6))(along_y)[:, 1], burgers((9,))(u).mT.expand(2, 9, 6))


@pytest.mark.parametrize("wind", [0.8, -0.8])
def test_a_constant_wind_acts_on_each_fourier_mode_by_its_symbol(wind):
    n, nu, dt = 24, 5e-3, 0.3
    b = field((n,))
    a = operators.Burgers(torch.full((1, 1, n), wind, dtype=torch.float64), nu, dt)
    u, _ = prdp.linear_solve(a, b, DIRECT)
    theta = 2 * math.pi * torch.arange(n // 2 + 1, dtype=torch.float64) / n
    upwind = n * abs(wind) * (1 - torch.exp(-1j * math.copysign(1, wind) * theta))
    symbol = 1 + dt * upwind + dt * nu * 4 * n**2 * torch.sin(theta / 2) ** 2
    close(torch.fft.rfft(u), torch.fft.rfft(b) / symbol)


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-12), (torch.float32, 1e-3)])
def test_a_navier_stokes_step_leaves_no_divergence_and_no_mean_pressure(dtype, bound):
    u = field((8, 6), channels=3).to(dtype)
    step = prdp.NavierStokes((8, 6), 1e-3, 0.1, solver=prdp.Direct())
    u_next = step(u)
    assert fields.divergence(u).abs().max() > 1 and step.converged
    assert fields.divergence(u_next).abs().max() < bound
    assert u_next[:, 2].mean((1, 2)).abs().max() < bound
    u[:, 2] += field((8, 6))[:, 0].to(dtype)
    assert torch.equal(step(u), u_next)  # whatever the pressure was


def test_without_pressure_and_wind_navier_stokes_is_diffusion():
    """A shear flow u₁(y) blows along itself and needs no pressure: every Fourier mode decays alone."""
    n, nu, dt = 12, 2e-2, 0.3
    y = torch.arange(n, dtype=torch.float64) / n
    shear = torch.cos(2 * math.pi * y)[:, None].expand(n, 5)
    u = torch.stack([shear, torch.zeros_like(shear), torch.zeros_like(shear)])[None]
    close(navier_stokes((n, 5), nu, dt)(u), u / (1 + dt * nu * 4 * n**2 * math.sin(math.pi / n) ** 2))


def orders(errors):
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


def after(make, u, final, steps):
    step = make(u.shape[2:], dt=final / steps)
    return fields.rollout(step, u, steps)[:, -1]


@pytest.mark.parametrize("make, final", [(burgers, 0.1), (navier_stokes, 0.2)])
def test_first_order_in_time_towards_a_refined_solution(make, final):
    if make is burgers:
        x = torch.arange(32, dtype=torch.float64) / 32
        u = (torch.sin(2 * math.pi * x) + 0.5 * torch.cos(4 * math.pi * x))[None, None]
    else:
        u = vortices(6, 1.0) + 0.3 * vortices(6, 1.0).roll((2, 1), (2, 3)).flip(1).roll(1, 1)
        u = fields.project(u)
    refined = after(make, u, final, 400)
    errors = [float((after(make, u, final, steps) - refined)[:, :2].abs().max()) for steps in (8, 16, 32)]
    np.testing.assert_allclose(orders(errors), 1.0, atol=0.2)


def vortices(n, amplitude):
    """Taylor-Green: u₁ = sin(2πx) cos(2πy), u₂ = -cos(2πx) sin(2πy) on their faces; p = 0."""
    face = 2 * math.pi * torch.arange(n, dtype=torch.float64) / n
    centre = face + math.pi / n
    u1, u2 = torch.outer(centre.cos(), face.sin()), -torch.outer(face.sin(), centre.cos())
    return amplitude * torch.stack([u1, u2, torch.zeros(n, n, dtype=torch.float64)])[None]


def test_taylor_green_vortices_decay_at_first_order_towards_the_exact_rate():
    nu, final, amplitude, errors = 0.05, 0.2, 0.2, []
    for n in (5, 10, 20):
        u = vortices(n, amplitude)
        assert fields.divergence(u).abs().max() < 1e-12
        u_end = after(lambda shape, dt: navier_stokes(shape, nu, dt), u, final, n // 5)
        exact = math.exp(-8 * math.pi**2 * nu * final) * u
        errors.append(float((u_end - exact)[:, :2].abs().max()) / amplitude)
    assert errors[-1] < 0.04 and orders(errors)[-1] > 0.8


def test_a_mean_velocity_that_float32_would_lose_is_refused():
    """Where nothing but 1, beside coefficients of 1e7, holds it."""
    settings = {"nu": 3000.0, "dt": 1.0, "force": (1e-6, 0.0)}
    u = torch.zeros(1, 2, 32, 32)
    periodic = prdp.Flow((32, 32), **settings)
    with pytest.raises(ValueError, match=r"float32 loses the mean velocity of a periodic box, .* got 1.2288e\+07"):
        periodic(u)
    mean = periodic(u.double())[0, 0].mean().item()
    assert abs(mean - 1e-6) < 1e-11
    assert (periodic.project(u) == 0).all() and (periodic.divergence(u) == 0).all()  # which diffuse nothing
    assert torch.equal(periodic.rollout(u, 0)[:, 0], u)
    solid = torch.zeros(32, 32, dtype=torch.bool)
    with pytest.raises(ValueError, match="float32 loses the mean"):
        prdp.Flow((32, 32), obstacle=solid, **settings)(u)
    solid[8:12, 8:12] = True
    for holds in ({"boundary": "wall"}, {"obstacle": solid}):
        v = prdp.Flow((32, 32), **holds, **settings)(u)
        exact = prdp.Flow((32, 32), **holds, **settings)(u.double())
        torch.testing.assert_close(v.double(), exact, rtol=1e-3, atol=1e-3 * exact.abs().max().item())
