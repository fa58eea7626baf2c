"""Find a diffusivity field from states that it diffuses: `python examples/variable_diffusion.py [N EPOCHS]`."""

import sys

import torch

import prdp_torch as prdp

n, epochs = map(int, sys.argv[1:]) if sys.argv[1:] else (32, 60)
dt, OFFSETS = 0.02, [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]


def diffusion(kappa: torch.Tensor) -> prdp.operators.Stencil:
    """I - dt ∇·(κ ∇) for κ (ny, nx) on a periodic grid, with the mean κ on the faces between cells."""
    east, north = (dt * n**2 * (kappa + kappa.roll(-1, axis)) / 2 for axis in (-1, -2))
    west, south = east.roll(1, -1), north.roll(1, -2)
    rows = torch.stack([1 + east + west + north + south, -west, -east, -south, -north])
    return prdp.operators.Stencil(rows[None], OFFSETS, boundary="periodic")


torch.manual_seed(0)
y, x = torch.meshgrid(torch.arange(n) / n, torch.arange(n) / n, indexing="ij")
true = 0.02 * torch.exp(torch.sin(2 * torch.pi * x) * torch.cos(2 * torch.pi * y))
u0 = torch.stack([torch.sin(2 * torch.pi * (k * x + j * y)) for k, j in ((1, 0), (0, 1), (1, 1), (1, -2))])[:, None]
observed = prdp.ImplicitStep(diffusion(true), solver=prdp.CG(max_iter=1000)).rollout(u0, 10)[:, 5::5]

log_kappa = torch.nn.Parameter(torch.full((n, n), 0.02).log())
operator: prdp.operators.Stencil  # made anew in every update
step = prdp.ImplicitStep(lambda u: operator, solver=prdp.CG(max_iter=1000))
controller = prdp.ToleranceController([step])
optimiser = torch.optim.Adam([log_kappa], lr=0.05)
for _ in range(epochs):
    optimiser.zero_grad()
    operator = diffusion(log_kappa.exp())  # once for all steps of the rollout
    misfit = (step.rollout(u0, 10)[:, 5::5] - observed).norm() / observed.norm()
    misfit.backward()
    optimiser.step()
    controller.step(misfit)
error = (log_kappa.detach().exp() - true).norm() / true.norm()
print(f"misfit {misfit.detach():.4f}  error of the field {error:.4f}  tolerance {controller.rtol:.1e}")
