"""The adjoint solves of auto are loose, but not so loose that a training ends worse for it in as many epochs."""

import math

import pytest
import torch

import prdp_torch as prdp

N, SAMPLES, BATCH = 32, 80, 20


def waves(seed):
    """Random sums of the seven longest waves of a periodic square."""
    angle = torch.arange(N) / N * 2 * math.pi
    modes = torch.stack([wave(k * angle) for k in range(7) for wave in (torch.sin, torch.cos)])
    weights = torch.randn(SAMPLES, 14, 14, generator=torch.Generator().manual_seed(seed))
    return torch.einsum("bij,iy,jx->byx", weights, modes, modes)[:, None]


def emulator_of(kappa, epochs, refine):
    """Train a linear network to make the first of two steps, through the second. Returns its error and the products."""
    A = prdp.operators.Diffusion(torch.full((1, N, N), kappa), shift=1.0, boundary="periodic")
    exact = prdp.ImplicitStep(A, solver=prdp.Direct())
    u0 = waves(seed=0)
    u1 = exact(u0)
    u2 = exact(u1)
    step = prdp.ImplicitStep(A, solver=prdp.CG(5000), start="state")
    controller = prdp.ToleranceController([step]) if refine else None
    multipliers = torch.zeros(N, N // 2 + 1, 2, requires_grad=True)
    optimizer = torch.optim.Adam([multipliers], 0.02)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    products = 0

    def network(u):
        return u + torch.fft.irfft2(torch.fft.rfft2(u) * torch.view_as_complex(multipliers))

    for _ in range(epochs):
        for batch in torch.arange(SAMPLES).split(BATCH):
            optimizer.zero_grad()
            (step(network(u0[batch])) - u2[batch]).square().mean().backward()
            optimizer.step()
            products += int(step.info.operator_applications.sum() + step.info.adjoint.operator_applications.sum())
        decay.step()
        error = float((network(u0).detach() - u1).norm() / u1.norm())
        if controller:
            controller.step(error)
    return error, products


@pytest.mark.parametrize(("kappa", "epochs"), [(0.01, 60), (1.0, 40)])
def test_an_emulator_trained_through_cg_ends_as_with_accurate_solves(kappa, epochs):
    """With adjoint solves to 1/2 it ended 18 times, and four times, as far off."""
    accurate, most = emulator_of(kappa, epochs, refine=False)
    auto, products = emulator_of(kappa, epochs, refine=True)
    assert auto < 1.15 * accurate
    assert products < 0.7 * most
