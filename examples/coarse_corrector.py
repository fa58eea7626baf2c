"""A network corrects a coarse solver towards one with four times as many points and time steps, and draws what it
gains: `python examples/coarse_corrector.py [N UPDATES]` writes coarse_corrector.png."""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

import prdp_torch as prdp
from prdp_torch.experiments.charts import make_figure, write_png

n, updates = map(int, sys.argv[1:]) if sys.argv[1:] else (64, 300)
fine, dt, nu = 4 * n, 0.02, 2e-3


def trajectories(samples: int, steps: int) -> torch.Tensor:
    """States of the fine solver at the points and times of the coarse one: (samples, steps + 1, 1, n)."""
    x, k = torch.arange(fine) / fine, torch.arange(1, 4)[:, None]
    waves = torch.cat([torch.sin(2 * torch.pi * k * x), torch.cos(2 * torch.pi * k * x)])
    step = prdp.Burgers((fine,), nu=nu, dt=dt / 4, solver=prdp.GMRES(max_iter=100, restart=8, rtol=1e-4))
    with torch.no_grad():
        return prdp.fields.rollout(step, (0.5 * torch.randn(samples, 6) @ waves)[:, None], 4 * steps)[:, ::4, :, ::4]


def corrected(u: torch.Tensor) -> torch.Tensor:
    u = coarse(u)
    return torch.add(u, network(u))


@torch.no_grad()
def errors(step: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
    """The mean relative error after each step on the validation samples."""
    off = prdp.fields.rollout(step, valid[:, 0], valid.shape[1] - 1) - valid
    return (off.square().sum((2, 3)) / valid.square().sum((2, 3))).sqrt().mean(0)


torch.manual_seed(0)
train, valid = trajectories(200, 4), trajectories(20, 12)
coarse = prdp.Burgers((n,), nu=nu, dt=dt, solver=prdp.GMRES(max_iter=100, restart=8))  # the controller sets rtol
layer = partial(torch.nn.Conv1d, kernel_size=5, padding=2, padding_mode="circular")
network = torch.nn.Sequential(layer(1, 32), torch.nn.Tanh(), layer(32, 1))
optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
controller, before = prdp.ToleranceController([coarse]), errors(coarse)
for update in range(1, updates + 1):
    batch = train[torch.randperm(200)[:25]]
    optimiser.zero_grad()
    (prdp.fields.rollout(corrected, batch[:, 0], 4) - batch).square().mean().backward()  # through four solver steps
    optimiser.step()
    if update % 20 == 0:
        controller.step(errors(corrected)[4])
after = errors(corrected)
print(f"error after 4 steps {after[4]:.3f}, coarse {before[4]:.3f}; 12 steps {after[12]:.3f}, coarse {before[12]:.3f}")
figure, (axes,) = make_figure()
axes.plot(before, "--", label="coarse solver alone")
axes.plot(after, label="corrected")
axes.set(title="one seed", xlabel="time steps; four are trained through", ylabel="relative error, 20 samples")
axes.legend(frameon=False)
write_png(figure, Path("coarse_corrector.png"), dpi=100)
