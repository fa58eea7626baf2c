"""Laws of the discrete equations, and their convergence to the continuous ones."""

import math

import numpy as np
import pytest
import torch
from helpers import field

import prdp_torch as prdp

DIRECT = prdp.Direct(rtol=1e-12)


def sine(shape, waves):
    wave = torch.ones((), dtype=torch.float64)
    for n, k in zip(shape, waves, strict=True):
        x = torch.arange(1, n + 1, dtype=torch.float64) / (n + 1)
        wave = wave.unsqueeze(-1) * torch.sin(math.pi * k * x)
    return wave[None, None]


def eigenvalue(shape, waves):
    """Of the discrete Laplacian: -Σ 4 sin²(πk/(2(N+1)))/dx²."""
    return -sum(
        4 * (n + 1) ** 2 * math.sin(math.pi * k / (2 * (n + 1))) ** 2 for n, k in zip(shape, waves, strict=True)
    )


@pytest.mark.parametrize("shape, waves", [((30,), (3,)), ((12, 9), (2, 5)), ((5, 7, 6), (1, 2, 3))])
def test_a_sine_mode_decays_by_the_exact_discrete_factor(shape, waves):
    u = sine(shape, waves)
    for solver in (DIRECT, prdp.CG(500, rtol=1e-13)):
        u_next = prdp.Heat(shape, 2e-3, 0.3, solver=solver)(u)
        torch.testing.assert_close(u_next, u / (1 - 2e-3 * 0.3 * eigenvalue(shape, waves)), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("shape, waves", [((31,), (2,)), ((8, 11), (1, 3)), ((4, 5, 6), (2, 1, 2))])
def test_poisson_inverts_the_exact_discrete_eigenvalue(shape, waves):
    p = sine(shape, waves)
    torch.testing.assert_close(
        prdp.Poisson(shape, solver=DIRECT)(p), -p / eigenvalue(shape, waves), rtol=1e-11, atol=1e-13
    )


def test_jacobi_damps_a_mode_by_its_known_factor_each_sweep():
    u = sine((30,), (4,))
    heat = prdp.Heat((30,), 1e-3, 1.0, solver=prdp.Jacobi(1, rtol=0.0))
    diagonal, lam = 1 + 2e-3 * 31**2, 1 - 1e-3 * eigenvalue((30,), (4,))
    for k in (1, 2, 9):
        heat.max_iter = k
        factor = (1 - (1 - lam / diagonal) ** k) / lam
        torch.testing.assert_close(heat(u), factor * u, rtol=1e-11, atol=1e-13)


def test_heat_obeys_the_maximum_principle_and_loses_energy():
    heat = prdp.Heat((20, 20), 1e-2, 0.1, solver=DIRECT)
    u = field((20, 20), batch=5)
    for _ in range(4):
        u_next = heat(u)
        assert u_next.amax() <= max(0.0, u.amax()) and u_next.amin() >= min(0.0, u.amin())
        assert (u_next.square().sum((1, 2, 3)) < u.square().sum((1, 2, 3))).all()
        u = u_next


def test_reflections_and_swapped_axes_commute_with_a_step():
    heat = prdp.Heat((9, 9), 1e-3, 1.0, solver=prdp.Jacobi(7, rtol=0.0))
    u = field((9, 9))
    torch.testing.assert_close(heat(u.flip(3)), heat(u).flip(3), rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(heat(u.flip(2)), heat(u).flip(2), rtol=1e-13, atol=1e-14)
    torch.testing.assert_close(heat(u.transpose(2, 3)), heat(u).transpose(2, 3), rtol=1e-13, atol=1e-14)


def test_no_diffusion_is_the_identity():
    u = field((14,))
    for solver in (DIRECT, prdp.Jacobi(5), prdp.CG(5), prdp.SteepestDescent(5)):
        assert torch.equal(prdp.Heat((14,), 0.0, 1.0, solver=solver)(u), u)


def orders(errors):
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


def test_first_order_in_time_towards_the_exact_decay():
    shape, final, errors = (40,), 0.5, []
    u0 = sine(shape, (1,))
    exact = math.exp(0.2 * eigenvalue(shape, (1,)) * final)
    for steps in (8, 16, 32, 64):
        heat, u = prdp.Heat(shape, 0.2, final / steps, solver=DIRECT), u0
        for _ in range(steps):
            u = heat(u)
        errors.append(float((u - exact * u0).abs().max()))
    np.testing.assert_allclose(orders(errors), 1.0, atol=0.12)


def test_second_order_in_space_towards_the_exact_solution():
    errors = []
    for n in (7, 15, 31, 63):
        x = torch.arange(1, n + 1, dtype=torch.float64) / (n + 1)
        # -u'' = p with u = sin(πx) eˣ
        exact = torch.sin(math.pi * x) * x.exp()
        p = -((1 - math.pi**2) * torch.sin(math.pi * x) + 2 * math.pi * torch.cos(math.pi * x)) * x.exp()
        errors.append(float((prdp.Poisson((n,), solver=DIRECT)(p[None, None]) - exact).abs().max()))
    np.testing.assert_allclose(orders(errors), 2.0, atol=0.1)


def test_unequal_spacings_are_taken_from_each_axis():
    """-Δu = p with u = sin(πx) sin(πy) on a grid that is four times finer in y."""
    ny, nx = 63, 15
    y, x = (torch.arange(1, n + 1, dtype=torch.float64) / (n + 1) for n in (ny, nx))
    exact = torch.sin(math.pi * y)[:, None] * torch.sin(math.pi * x)[None, :]
    u = prdp.Poisson((ny, nx), solver=DIRECT)((2 * math.pi**2 * exact)[None, None])
    assert float((u - exact).abs().max()) < 3e-3
