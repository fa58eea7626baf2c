"""Dye that a flow carries, and where it came from: `python examples/passive_scalar.py [N STEPS]`."""

import sys

import torch

import prdp_torch as prdp

n, steps = map(int, sys.argv[1:]) if sys.argv[1:] else (32, 40)
dt, diffusivity = 0.5 / n, 1e-3
OFFSETS = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
flow = prdp.Flow((n, n), nu=1e-2, dt=dt, boundary=("wall", "periodic"))


def dye_operator(u: torch.Tensor) -> prdp.operators.Stencil:
    """I + dt (∇·(u c) - D Δc), upwind and implicit, from the velocities on the low faces of the cells."""
    faces = []
    for velocity, axis in ((u[:, 0], -1), (u[:, 1], -2)):
        low = dt * n * velocity
        wall = torch.ones(n, 1) if axis == -2 else torch.ones(1, n)
        wall[0] = axis == -1  # nothing passes the walls
        spread = dt * n**2 * diffusivity * wall
        into = low.clamp(min=0) + spread, low.clamp(max=0) - spread  # from the cell before, and from the cell itself
        faces.append((*into, into[0].roll(-1, axis), into[1].roll(-1, axis)))
    (left, left_own, right_own, right), (down, down_own, up_own, up) = faces
    rows = torch.stack([1 - left_own + right_own - down_own + up_own, -left, right, -down, up], 1)
    return prdp.operators.Stencil(rows, OFFSETS, "periodic")


y, x = torch.meshgrid(*[(torch.arange(n) + 0.5) / n] * 2, indexing="ij")
across = torch.sin(torch.pi * y)
u = flow.project(torch.stack([across, 0.3 * torch.sin(2 * torch.pi * x) * across])[None])
dye = prdp.ImplicitStep(lambda c: dye_operator(u), solver=prdp.GMRES(max_iter=50, rtol=1e-6, preconditioner="diagonal"))
c = start = torch.exp(-((x - 0.3) ** 2 + (y - 0.5) ** 2) / 0.01)[None, None].requires_grad_()
for _ in range(steps):
    c, u = dye(c), flow(u)
(gradient,) = torch.autograd.grad(c[0, 0, n // 2, 3 * n // 4], start)
print(f"dye {start.sum().item() / n**2:.5f} before, {c.sum().item() / n**2:.5f} after; largest {c.max().item():.3f}")
print("a probe at (0.75, 0.5) sees most of what started at", divmod(int(gradient.argmax()), n)[::-1])
