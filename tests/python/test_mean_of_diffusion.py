"""float32 `Diffusion` that no side holds, in steps so large that a rounded diagonal would change the mean of u."""

import numpy as np
import pytest
import torch

import prdp_torch as prdp
from prdp_torch.operators import Diffusion

# The residual is the rounding of u, times κ Δt/dx²: u is right.
pytestmark = pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol")

F64 = torch.float64
LARGE = 1e5  # κ Δt/dx²
SHAPES = [(96,), (24, 20), (8, 6, 9)]
# The other methods do not get there without a preconditioner.
METHODS = {
    "Direct": prdp.Direct(),
    "CG": prdp.CG(300, rtol=1e-6),
    "Multigrid": prdp.Multigrid(30, rtol=1e-6),
    **{
        f"{method.__name__}, multigrid": method(30, rtol=1e-6, preconditioner="multigrid")
        for method in (prdp.CG, prdp.MINRES, prdp.BiCGStab, prdp.GMRES)
    },
}


def rand(*shape, seed=0):
    return 0.3 + torch.rand(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def mean(u):
    return u.double().flatten(2).mean(2)


def steps(kappa, shift, boundary, solver, count, u):
    """As many steps of implicit Euler with Δt = 1/shift, and what the last solve said."""
    a = Diffusion(kappa, shift=shift, boundary=boundary, length=[float(n) for n in kappa.shape[1:]])
    for _ in range(count):
        u, info = prdp.linear_solve(a, shift * u, solver)
    return u, info


@pytest.mark.parametrize("boundary", ["periodic", "flux"])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("name", METHODS)
def test_steps_keep_the_mean(name, shape, boundary):
    """Of a batch: κ that is one number, one field for all samples, and one for each."""
    u0 = rand(2, 2, *shape, seed=1).float()
    for kappa in (torch.ones(1, *shape), rand(1, *shape).float(), rand(2, *shape).float()):
        u, info = steps(kappa, 1 / LARGE, boundary, METHODS[name], 20, u0)
        assert info.solved.all()
        assert ((mean(u) - mean(u0)) / mean(u0)).abs().max() < 1e-5


@pytest.mark.parametrize("boundary", ["periodic", "flux"])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("name", METHODS)
def test_u_and_its_adjoint_are_those_of_float64(name, shape, boundary):
    """Against LAPACK; and however the shift varies, the sum of shift·u is that of b."""
    b, w = (rand(2, 1, *shape, seed=seed).float() for seed in (1, 2))
    kappa, lengths = rand(1, *shape).float(), [float(n) for n in shape]
    for shift in (torch.full((1, *shape), 1 / LARGE), (rand(2, *shape, seed=3) / LARGE).float()):
        exact = Diffusion(kappa.double(), shift=shift.double(), boundary=boundary, length=lengths).dense()
        rhs = b.clone().requires_grad_()
        u, _ = prdp.linear_solve(Diffusion(kappa, shift=shift, boundary=boundary, length=lengths), rhs, METHODS[name])
        (b_bar,) = torch.autograd.grad((w * u).sum(), rhs, retain_graph=True)
        (recorded,) = torch.autograd.grad((w * u).sum(), rhs, create_graph=True)
        for found, of in ((u, b), (b_bar, w), (recorded, w)):
            torch.testing.assert_close(mean(shift[:, None] * found.double()), mean(of), rtol=1e-5, atol=0)
            expected = np.linalg.solve(exact.numpy(), of.double().flatten(1).numpy()[..., None])[..., 0]
            error = found.detach().double().flatten(1).numpy() - expected
            assert np.linalg.norm(error) < 1e-5 * np.linalg.norm(expected)


@pytest.mark.parametrize("boundary", ["periodic", "flux"])
def test_where_kappa_is_one_number_a_shift_that_varies_is_no_rounding(boundary):
    """Beside the diagonal it is as small as what `Direct` overlooks in a sum of operators along the axes."""
    kappa, shift = torch.ones(1, 24, 20), (rand(1, 24, 20, seed=3) / LARGE).float()
    b = rand(1, 1, 24, 20, seed=1).float()
    u, _ = prdp.linear_solve(Diffusion(kappa, shift=shift, boundary=boundary, length=[24.0, 20.0]), b, prdp.Direct())
    torch.testing.assert_close(mean(shift * u.double()), mean(b), rtol=1e-6, atol=0)


@pytest.mark.parametrize("boundary", ["periodic", "flux"])
def test_products_of_a_constant_are_the_shift(boundary):
    for kappa in (rand(1, 17).float(), rand(2, 5, 4).float(), rand(1, 3, 2, 5).float()):
        shift = (1e-7 * rand(1, *kappa.shape[1:], seed=3)).float()
        found = Diffusion(1e3 * kappa, shift=shift, boundary=boundary).apply(torch.ones(2, 1, *kappa.shape[1:]))
        assert torch.equal(found, shift[:, None].expand_as(found))


@pytest.mark.parametrize("shape", [(16, 16), (3, 40), (6, 5, 7)], ids=str)
@pytest.mark.parametrize("spread", [0.0, 1e-7, 1e-6, 1e-4])
def test_direct_steps_keep_the_mean_where_kappa_is_almost_one_number(spread, shape):
    """Beside a diagonal, how κ varies passes for rounding."""
    for size in (1.0, 1e3):
        kappa = (size * (1 + spread * rand(1, *shape))).float()
        u0 = rand(1, 1, *shape, seed=1).float()
        a = Diffusion(kappa, shift=1 / LARGE, boundary="flux", length=[float(n) for n in shape])
        u, _ = prdp.linear_solve(a, u0 / LARGE, prdp.Direct())
        assert (mean(u) / mean(u0) - 1).abs().max() < 1e-5


def test_direct_steps_keep_the_mean_where_kappa_differs_between_the_axes():
    """That of the other axis is a hundred thousand times as large."""
    small = 1 + 0.3 * rand(1, 1, 16, 16)
    kappa = torch.cat([small, 1e5 * torch.ones_like(small)], 1)
    u0 = rand(1, 1, 16, 16, seed=1)
    options = {"shift": 1.0, "boundary": "flux", "per_axis": True}
    u, _ = prdp.linear_solve(Diffusion(kappa.float(), **options), u0.float(), prdp.Direct())
    exact, _ = prdp.linear_solve(Diffusion(kappa, **options), u0, prdp.Direct())
    assert (mean(u) / mean(u0) - 1).abs().max() < 1e-5 and (u - exact).norm() < 1e-5 * exact.norm()
