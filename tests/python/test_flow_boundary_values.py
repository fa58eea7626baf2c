"""Values at the boundary that are not finite, and cotangents of the pressure alone, leave no wrong gradient."""

import pytest
import torch
from helpers import modes

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def inflow(bad):
    v = torch.zeros(3, 2, 8, 1, dtype=F64)
    v[:, 0] = torch.tensor([0.5, 0.4, 0.6], dtype=F64).view(3, 1, 1)
    if bad:
        v[1, 0, 2] = torch.nan
    return {"boundary": ("wall", "open"), "inflow": v}


def wall(bad):
    v = torch.zeros(3, 2, 8, dtype=F64)
    v[:, 0] = 0.5
    if bad:
        v[1, 0, 2] = torch.inf
    return {"boundary": "wall", "wall_velocity": {(0, "high"): v}}


@modes
@pytest.mark.parametrize("on_failure", ["zero_grad", "return"])
@pytest.mark.parametrize("make", [inflow, wall])
@pytest.mark.parametrize("steps", [1, 2])
def test_a_sample_with_nan_at_its_boundary_spoils_no_gradient(make, on_failure, backward, steps):
    u = 0.1 * torch.randn(3, 2, 8, 8, dtype=F64, generator=torch.Generator().manual_seed(0))

    def gradients(samples, bad):
        given = make(bad)
        nu = torch.tensor(0.01, dtype=F64, requires_grad=True)
        name = "inflow" if "inflow" in given else "wall_velocity"
        values = given[name] if name == "inflow" else given[name][0, "high"]
        leaf = values[samples].clone().requires_grad_()
        given[name] = leaf if name == "inflow" else {(0, "high"): leaf}
        flow = prdp.Flow((8, 8), nu, 0.01, on_failure=on_failure, backward=backward, **given)
        states = flow.rollout(u[samples], steps)
        assert states.isfinite().all()
        prdp.detach_failed(states, flow.info)[:, -1].square().sum().backward()
        return nu.grad, leaf.grad

    nu_bar, leaf_bar = gradients([0, 1, 2], bad=True)
    nu_alone, leaf_alone = gradients([0, 2], bad=False)
    torch.testing.assert_close(nu_bar, nu_alone, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(leaf_bar[[0, 2]], leaf_alone, rtol=1e-10, atol=1e-12)
    assert leaf_bar[1].eq(0).all()


@pytest.mark.parametrize("nu", [0.0, 1e-5, 1e-4])
@pytest.mark.parametrize("shape", [(16, 16), (32, 32), (8, 8, 8)])
def test_a_probe_of_the_pressure_has_its_gradient_in_float32(shape, nu):
    generator = torch.Generator().manual_seed(1)
    u = 0.03 * torch.randn(1, len(shape), *shape, generator=generator)
    place = (0, 0, *(3 for _ in shape))

    def gradient(dtype, solver):
        leaf = u.detach().to(dtype, copy=True).requires_grad_()
        flow = prdp.Flow(shape, nu=nu, dt=1e-3, boundary="wall", solver=solver)
        flow.pressure(leaf)[place].backward()
        return leaf.grad.double()

    found, exact = gradient(torch.float32, prdp.CG(2000, rtol=1e-6)), gradient(F64, prdp.Direct())
    assert (found - exact).norm() <= 1e-3 * exact.norm()


@pytest.mark.parametrize("offset", [1.0, 30.0, 1000.0])
@pytest.mark.parametrize("solver", [prdp.CG(200, preconditioner="multigrid"), prdp.GMRES(50), prdp.Direct()],
                         ids=lambda s: type(s).__name__)  # fmt: skip
def test_a_large_constant_part_of_a_cotangent_counts_for_nothing(solver, offset):
    generator = torch.Generator().manual_seed(0)
    f = torch.randn(2, 1, 16, 16, generator=generator)
    f -= f.mean((2, 3), keepdim=True)
    kappa = torch.rand(1, 16, 16, generator=generator) + 0.5

    def gradient(dtype, solver, offset):
        leaf = kappa.detach().to(dtype, copy=True).requires_grad_()
        u, _ = prdp.linear_solve(operators.Diffusion(leaf, boundary="flux"), f.to(dtype), solver)
        (u + offset).square().mean().backward()
        return leaf.grad.double()

    found, exact = gradient(torch.float32, solver, offset), gradient(F64, prdp.Direct(), 0.0)
    assert (found - exact).norm() <= max(2e-3, 2e-4 * offset) * exact.norm()  # the rounding of a cotangent so large
