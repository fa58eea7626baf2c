"""A network that sets the force on a flow: `python examples/force_network.py [N UPDATES]`.

It learns to keep a vortex from decaying: from the velocity that it sees, it makes the force of the next time step."""

import math
import sys

import torch

import prdp_torch as prdp

n, updates = map(int, sys.argv[1:]) if sys.argv[1:] else (32, 60)
torch.manual_seed(0)
network = torch.nn.Sequential(
    torch.nn.Conv2d(2, 16, 3, padding=1, padding_mode="circular"),
    torch.nn.Tanh(),
    torch.nn.Conv2d(16, 2, 3, padding=1, padding_mode="circular"),
)
flow = prdp.Flow((n, n), nu=0.05, dt=0.1, length=2 * math.pi)
controller = prdp.ToleranceController([flow])
optimiser = torch.optim.Adam(network.parameters(), lr=1e-2)
faces, centres = (2 * math.pi / n * (torch.arange(n) + shift) for shift in (0.0, 0.5))
vortex = torch.stack(
    [torch.sin(faces)[None, :] * torch.cos(centres)[:, None], -torch.cos(centres)[None, :] * torch.sin(faces)[:, None]]
)
for _ in range(updates):
    target = (torch.rand(8, 1, 1, 1) + 0.5) * vortex
    u = target
    for _ in range(5):
        flow.force = network(u)
        u = flow(u)
    error = (u - target).norm() / target.norm()
    optimiser.zero_grad()
    error.backward()
    optimiser.step()
    controller.step(error)
unforced = 1 - math.exp(-2 * 0.05 * 0.5)
print(f"change of the vortex {error.item():.4f}, without the force {unforced:.4f}; tolerance {flow.rtol:.1e}")
