"""The tutorial of docs/first_emulator.md: `python examples/first_emulator.py [N EPOCHS]` writes first_emulator.png."""

import sys
import time
from pathlib import Path

import torch
from torch import nn

import prdp_torch as prdp
from prdp_torch.experiments.charts import make_figure, write_png

n, epochs = map(int, sys.argv[1:]) if sys.argv[1:] else (48, 40)
torch.manual_seed(0)
torch.set_num_threads(1)
x, dt = (torch.arange(n) + 0.5) / n, 1.0
kappa = 0.01 * torch.exp(1.5 * torch.sin(5 * x + 1) * torch.cos(4 * x[:, None]))[None]
ground = prdp.operators.Diffusion(kappa, shift=1 / dt)
waves = torch.sin(torch.pi * torch.arange(1, 4)[:, None] * x)
u0 = torch.einsum("bij,iy,jx->byx", torch.randn(120, 3, 3), waves, waves)[:, None]
exact = prdp.ImplicitStep(ground, lambda u: u / dt, prdp.Direct())
u2 = exact(u1 := exact(u0))


def train(auto: bool) -> list[tuple[float, float, float]]:
    """Seconds so far, validation error and iterations of the last solve after each epoch."""
    solver = prdp.CG(max_iter=2000, preconditioner="diagonal")
    step = prdp.ImplicitStep(ground, lambda u: u / dt, solver, start="state" if auto else "zero")
    controller = prdp.ToleranceController([step] if auto else [])
    torch.manual_seed(1)
    last = nn.Linear(64, n * n, bias=False)
    nn.init.zeros_(last.weight)
    network = nn.Sequential(nn.Flatten(), nn.Linear(n * n, 64), nn.ReLU(), last, nn.Unflatten(1, (1, n, n)))
    optimiser = torch.optim.Adam(network.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
    rows, begin = [], time.process_time()
    for _ in range(epochs):
        for batch in torch.randperm(100).split(20):
            optimiser.zero_grad()
            nn.functional.mse_loss(step(network(u0[batch])), u2[batch]).backward()
            optimiser.step()
        schedule.step()
        with torch.no_grad():
            error = float((network(u0[100:]) - u1[100:]).norm() / u1[100:].norm())
        controller.step(error)
        iterations = step.info.iterations.float().mean() if step.info else torch.zeros(())
        rows.append((time.process_time() - begin, error, float(iterations)))
    return rows


figure, (left, right) = make_figure(panels=2, height=3.6)
for auto, title, colour in ((False, "accurate solves", "#222222"), (True, "auto", "#1f77b4")):
    seconds, errors, iterations = zip(*train(auto), strict=True)
    print(f"{title}: error {errors[-1]:.3f}, {seconds[-1]:.2f} s, {iterations[-1]:.0f} iterations at last")
    left.plot(seconds, errors, color=colour, label=title)
    right.plot(range(1, epochs + 1), iterations, color=colour)
left.set(xlabel="seconds on one core, one seed", ylabel="relative validation error", ylim=(0, None))
left.legend(frameon=False)
right.set(xlabel="epoch", ylabel="CG iterations of the last solve", ylim=(0, None))
write_png(figure, Path("first_emulator.png"), dpi=100)
