"""The lid-driven cavity beside Ghia, Ghia and Shin (1982): `python examples/lid_driven_cavity.py [N REYNOLDS]`."""

import sys

import torch

import prdp_torch as prdp

n, reynolds = map(int, sys.argv[1:]) if sys.argv[1:] else (32, 100)
# u at the heights y above the middle of the floor, from their table I
HEIGHTS = torch.tensor(
    [0.0625, 0.1016, 0.1719, 0.2813, 0.4531, 0.5, 0.6172, 0.7344, 0.8516, 0.9531], dtype=torch.float64
)
GHIA = {
    100: [-0.04192, -0.06434, -0.10150, -0.15662, -0.21090, -0.20581, -0.13641, 0.00332, 0.23151, 0.68717],
    400: [-0.09266, -0.14612, -0.24299, -0.32726, -0.17119, -0.11477, 0.02135, 0.16256, 0.29093, 0.55892],
    1000: [-0.20196, -0.29730, -0.38289, -0.27805, -0.10648, -0.06080, 0.05702, 0.18719, 0.33304, 0.46604],
}
lid = torch.nn.Parameter(torch.ones(n, dtype=torch.float64))  # the speed along x, one per face
velocity = torch.stack([lid, torch.zeros_like(lid)])[None]
dt = min(0.5 / n, 4 / reynolds)
cavity = prdp.Flow((n, n), 1 / reynolds, dt, boundary="wall", wall_velocity={(0, "high"): velocity})
u, change = torch.zeros(1, 2, n, n, dtype=torch.float64), 1.0
with torch.no_grad():
    while change > 1e-4:
        before, u = u, cavity.rollout(u, 50)[:, -1]
        change = ((u - before).abs().max() / (50 * dt)).item()


def at_heights(u: torch.Tensor, heights: torch.Tensor) -> torch.Tensor:
    """u in the middle, between the centres of the cells and the walls, which have the speeds 0 and 1."""
    row = torch.cat([-u[0, 0, :1, n // 2], u[0, 0, :, n // 2], 2.0 - u[0, 0, -1:, n // 2]])
    place = heights * n + 0.5
    low = place.long().clamp(max=n)
    return row[low] + (place - low) * (row[low + 1] - row[low])


u = cavity.rollout(u, 20)[:, -1]
profile = at_heights(u, HEIGHTS)
(gradient,) = torch.autograd.grad(profile[HEIGHTS == 0.5].sum(), lid)
error = (profile.detach() - torch.tensor(GHIA[reynolds], dtype=torch.float64)).abs().max()
print(f"u in the centre {profile[HEIGHTS == 0.5].item():.4f}; largest difference from Ghia {error:.4f}")
