"""Find a permeability from noisy pressures, and draw it: `python examples/inverse_permeability.py [N UPDATES]` writes
inverse_permeability.png."""

import sys
from pathlib import Path

import torch

import prdp_torch as prdp
from prdp_torch.experiments.charts import make_figure, write_png

n, updates = map(int, sys.argv[1:]) if sys.argv[1:] else (48, 150)
SOLVER = prdp.CG(max_iter=100, rtol=1e-3, preconditioner="multigrid")


def darcy(log_kappa: torch.Tensor) -> prdp.operators.Diffusion:
    """p ↦ -∇·(κ ∇p) with p = 0 on the sides."""
    return prdp.operators.Diffusion(log_kappa.exp())


torch.manual_seed(0)
y, x = torch.meshgrid(*[(torch.arange(n) + 0.5) / n] * 2, indexing="ij")
true = (1.5 * torch.sin(5 * x + 1) * torch.cos(4 * y))[None]
wells = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)]
sources = torch.stack([torch.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.01) for a, b in wells])[:, None]
exact = prdp.linear_solve(darcy(true), sources, prdp.Direct())[0]
observed = exact + 0.005 * exact.square().mean().sqrt() * torch.randn_like(exact)

log_kappa = torch.nn.Parameter(torch.zeros(1, n, n))
optimiser = torch.optim.Adam([log_kappa], lr=0.05)
pressures, iterations = None, []
for _ in range(updates):
    p, info = prdp.linear_solve(darcy(log_kappa), sources, SOLVER, adjoint_rtol=1e-2, x0=pressures)
    pressures = p.detach()  # κ has changed little by the next update: start there
    misfit = (p - observed).norm() / observed.norm()
    rough = log_kappa.diff(dim=1).square().sum() + log_kappa.diff(dim=2).square().sum()
    optimiser.zero_grad()
    (misfit.square() + 1e-5 * rough).backward()
    optimiser.step()
    iterations.append(float(info.iterations.float().mean()))
found = log_kappa.detach()
error = (found.exp() - true.exp()).norm() / true.exp().norm()
print(f"misfit {misfit:.4f}, error of κ {error:.3f}, iterations {iterations[0]:.1f}, at last {iterations[-1]:.1f}")

figure, panels = make_figure(panels=3, height=3.2)
for axes, field, title in zip(panels, (true, found), ("true log κ", "found, one draw of noise"), strict=False):
    image = axes.imshow(field[0], vmin=-1.5, vmax=1.5, cmap="RdBu_r", origin="lower")
    axes.set(title=title, xticks=[], yticks=[])
figure.colorbar(image, ax=panels[:2], shrink=0.8)
panels[2].plot(iterations, color="#0072B2")
panels[2].set(xlabel="update", title="CG iterations of a solve", ylim=(0, None))
write_png(figure, Path("inverse_permeability.png"), dpi=100)
