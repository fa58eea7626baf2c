"""The lid-driven cavity beside Ghia, Ghia and Shin (1982): `python examples/lid_driven_cavity.py [N REYNOLDS]`."""

import sys

import torch

import prdp_torch as prdp

n, reynolds = map(int, sys.argv[1:]) if sys.argv[1:] else (32, 100)
# u above the middle of the floor, at ten of the heights of their table I
HEIGHTS = [0.0625, 0.1016, 0.1719, 0.2813, 0.4531, 0.5, 0.6172, 0.7344, 0.8516, 0.9531]
GHIA = {
    100: [-0.04192, -0.06434, -0.10150, -0.15662, -0.21090, -0.20581, -0.13641, 0.00332, 0.23151, 0.68717],
    400: [-0.09266, -0.14612, -0.24299, -0.32726, -0.17119, -0.11477, 0.02135, 0.16256, 0.29093, 0.55892],
    1000: [-0.20196, -0.29730, -0.38289, -0.27805, -0.10648, -0.06080, 0.05702, 0.18719, 0.33304, 0.46604],
}
speed = torch.nn.Parameter(torch.ones(n))  # of the lid, one per face
lid = torch.stack([speed, torch.zeros(n)])[None]
dt = min(0.5 / n, 4 / reynolds)
cavity = prdp.Flow((n, n), nu=1 / reynolds, dt=dt, boundary="wall", wall_velocity={(0, "high"): lid})


def middle(u: torch.Tensor) -> torch.Tensor:
    """u at the heights, between the cells and the walls, beyond which are ghosts."""
    column = u[0, 0, :, n // 2]
    column = torch.cat([-column[:1], column, 2 - column[-1:]])
    place = n * torch.tensor(HEIGHTS) + 0.5
    low = place.long()
    return torch.lerp(column[low], column[low + 1], place - low)


u, change = torch.zeros(1, 2, n, n), torch.ones(1)
with torch.no_grad():
    while change.max() > 1e-3:  # per time
        before, u = u, cavity.rollout(u, 100)[:, -1]
        change = (u - before).abs() / (100 * dt)
profile = middle(cavity.rollout(u, 50)[:, -1])
(gradient,) = torch.autograd.grad(profile[5], speed)
error = (profile.detach() - torch.tensor(GHIA[reynolds])).abs().max()
print(f"u in the centre {profile[5].item():.4f}, largest difference from Ghia {error:.4f}")
