"""Maps of multigrid: products with A where cells couple unevenly, winds blow or sizes are odd."""

import numpy as np
import torch

from benchmarks.atlas import problems
from benchmarks.atlas.solves import lines, spaced
from prdp_torch import operators
from prdp_torch.solvers import CG, GMRES, BiCGStab, Multigrid

OF_SYMMETRIC = {
    "CG": CG(20000),
    'CG, preconditioner="diagonal"': CG(20000, preconditioner="diagonal"),
    'CG, preconditioner="multigrid"': CG(1000, preconditioner="multigrid"),
    "Multigrid": Multigrid(1000),
}
OF_WINDS = {
    "GMRES(20)": GMRES(restart=20, max_iter=500),
    'GMRES(5), preconditioner="multigrid"': GMRES(restart=5, max_iter=100, preconditioner="multigrid"),
    "BiCGStab": BiCGStab(5000),
    'BiCGStab, preconditioner="multigrid"': BiCGStab(500, preconditioner="multigrid"),
}


def smooth_diffusion(contrast, n=63):
    """-∇·(κ ∇u) with zeros on the sides and a smooth κ, max κ/min κ = contrast."""
    y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 2, indexing="ij")
    g = torch.tensor((1 + np.sin(3 * np.pi * y) * np.cos(5 * np.pi * x + y)) / 2)
    return operators.Diffusion(contrast ** g[None]), problems.noise(2, 1, n, n)


def stretched(ratio, n=63):
    """The Laplacian on cells that are `ratio` times as long as they are high."""
    return operators.Diffusion(torch.ones(1, n, n, dtype=torch.float64), length=[1.0, ratio]), problems.noise(
        2, 1, n, n
    )


def in_vortices(peclet, n=64):
    """`windy` in vortices, with max|w| dx = peclet."""
    y, x = np.meshgrid(*[np.arange(n) / n] * 2, indexing="ij")
    return windy(peclet * torch.tensor(np.stack([np.cos(2 * np.pi * x), np.sin(2 * np.pi * y)])))


def in_noise(peclet, n=64):
    """`windy` where winds turn from cell to cell: white noise with max|w| dx = peclet."""
    wind = problems.noise(1, 2, n, n)[0]
    return windy(peclet * wind / wind.abs().max())


def windy(winds):
    """u/dt + w·∇u - Δu, first-order upwind and periodic; dt is a hundredth. `winds` is w dx, (2, n, n)."""
    n = winds.shape[-1]
    sides, offsets = [], []
    for axis, wind in enumerate(winds):  # times 1/dx², as diffusion is
        for step, inflow in ((-1, wind.clamp(min=0)), (1, (-wind).clamp(min=0))):
            sides.append(-1 - inflow)
            offsets.append(tuple(step * (d == axis) for d in range(2)))
    centre = 100 / n**2 - sum(sides)
    a = operators.Stencil(n**2 * torch.stack([centre, *sides])[None], [(0, 0), *offsets], "periodic")
    return a, problems.noise(2, 1, n, n)


def contrast(quick):
    return _answered(lines(spaced(1, 1e6, 3 if quick else 7), smooth_diffusion, OF_SYMMETRIC), "a contrast of")


def anisotropy(quick):
    return _answered(lines(spaced(1, 1e3, 3 if quick else 7), stretched, OF_SYMMETRIC), "cells stretched by")


def sizes(quick):
    x = [16, 31] if quick else [8, 16, 31, 47, 64, 97, 128, 191, 255]
    return _answered(lines(x, lambda n: smooth_diffusion(100.0, n), OF_SYMMETRIC), "N =")


def vortices(quick):
    return _of_peclet(in_vortices, quick)


def rough_winds(quick):
    return _of_peclet(in_noise, quick)


def _of_peclet(problem, quick):
    data = lines(spaced(0.01, 100, 3 if quick else 9), problem, OF_WINDS)
    plain, cycles = (data["lines"][name][-1] for name in ("BiCGStab", 'BiCGStab, preconditioner="multigrid"'))
    return {**data, "answer": f"at a cell Péclet number of {data['x'][-1]:g}: {_pair('BiCGStab', plain, cycles)}"}


def _answered(data, what):
    plain, cycles = (data["lines"][name][-1] for name in ("CG", 'CG, preconditioner="multigrid"'))
    return {**data, "answer": f"at {what} {data['x'][-1]:,g}: {_pair('CG', plain, cycles)}"}


def _pair(method, plain, cycles):
    words = ["does not get there" if products is None else f"{products:,.0f} products" for products in (plain, cycles)]
    return f"{method} {words[0]}, with multigrid {words[1]}"
