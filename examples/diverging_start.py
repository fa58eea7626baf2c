"""A training that starts where the solver diverges, and recovers.

The diffusivity nu of u_t = -nu u_xxxx is found from states after one implicit step, each sample with a time step of
its own. Jacobi converges for nu dt/dx⁴ < 1/4 alone. The first guess of nu is twenty times too large, so that half the
samples diverge: with on_failure="raise" there is no first update. With "zero_grad" the other samples bring nu down,
until all of them converge.
"""

import torch
from torch import Tensor

import prdp_torch as prdp
from prdp_torch.types import OnFailure

N, OFFSETS = 16, [(0,), (-1,), (1,), (-2,), (2,)]
dt = torch.tensor([0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0], dtype=torch.float64) / N**4
start = torch.randn(len(dt), 1, N, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def step(nu: Tensor, solver: prdp.Solver, on_failure: OnFailure) -> tuple[Tensor, prdp.SolveInfo]:
    ratio = (nu * dt * N**4)[:, None, None]  # nu dt/dx⁴ of each sample
    stencil = torch.cat([1 + 6 * ratio, -4 * ratio, -4 * ratio, ratio, ratio], 1).expand(-1, -1, N)
    return prdp.linear_solve(prdp.operators.Stencil(stencil, OFFSETS, "periodic"), start, solver, on_failure=on_failure)


def train(on_failure: OnFailure, updates: int = 150) -> tuple[float, list[int]]:
    """The logarithm of nu over its true value, and how many samples failed in each update."""
    observed, _ = step(torch.tensor(0.04, dtype=torch.float64), prdp.Direct(), "raise")
    theta = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([theta], lr=0.1)
    failed: list[int] = []
    for _ in range(updates):
        u, info = step(0.04 * theta.exp(), prdp.Jacobi(max_iter=1000), on_failure)
        error = (u - observed).square().sum((1, 2)) / observed.square().sum((1, 2))
        optimiser.zero_grad()
        error.mean().backward()
        torch.nn.utils.clip_grad_norm_([theta], 0.3)  # a sample on the verge of divergence has no end to its gradient
        optimiser.step()
        failed.append(int(info.failed.sum()))
    return theta.item(), failed


if __name__ == "__main__":
    theta, failed = train("zero_grad")
    print(
        f"failed samples: {failed[0]} of {len(dt)} at the start, {failed[-1]} at the end; ln(nu / true) = {theta:.4f}"
    )
