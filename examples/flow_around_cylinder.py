"""Drag of a cylinder and its gradient for the inflow: `python examples/flow_around_cylinder.py [CELLS STEPS]`."""

import sys

import torch

import prdp_torch as prdp

cells, steps = map(int, sys.argv[1:]) if sys.argv[1:] else (8, 600)  # cells per diameter; time steps
reynolds, height, width = 20.0, 8, 12  # of a channel, in diameters
shape, h = (height * cells, width * cells), 1 / cells
y, x = torch.meshgrid(*((torch.arange(n, dtype=torch.float64) + 0.5) * h for n in shape), indexing="ij")
solid = (x - 4) ** 2 + (y - height / 2) ** 2 < 0.25

speed = torch.nn.Parameter(torch.ones(shape[0], dtype=torch.float64))  # the inflow along x, one per row
inflow = torch.stack([speed, torch.zeros_like(speed)])[None, :, :, None]
flow = prdp.Flow(  # above and below follow more cylinders
    shape, 1 / reynolds, 0.3 * h, boundary=("periodic", "open"), length=(height, width), obstacle=solid, inflow=inflow
)


def drag(u: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
    """Force along x per unit depth: pressure in the cells before and behind, friction on the faces beside the solid."""
    before, behind = solid.roll(-1, -1) & ~solid, solid.roll(1, -1) & ~solid
    surface, inside = solid ^ solid.roll(1, -1), solid & solid.roll(1, -1)
    beside = sum(2.0 * inside.roll(k, -2) + surface.roll(k, -2) + surface.roll(k, -1) for k in (-1, 1))
    return h * (p[:, 0] * before - p[:, 0] * behind).sum() + flow.nu * (u[:, 0] * beside).sum()


with torch.no_grad():
    u = flow.project(inflow.expand(1, 2, *shape))
    for _ in range(steps):
        u = flow(u)
u = flow.rollout(u, 20)[:, -1]
coefficient = 2 * drag(u, flow.pressure(u))
(gradient,) = torch.autograd.grad(coefficient, speed)
print(f"drag coefficient {coefficient:.3f}  divergence {flow.divergence(u).abs().max():.1e}")
print(f"its gradient for the inflow: {gradient.sum():.3f} in all, {gradient[shape[0] // 2]:.3f} before the cylinder")
