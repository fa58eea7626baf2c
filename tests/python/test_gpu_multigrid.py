"""Multigrid in the kernels of a GPU, run as fibers on the CPU, beside the CPU's own loops."""

import pytest
import torch
from fibers import BACKWARD, SHUFFLED, Fibers
from test_gpu_kernels import F32, F64, OFFSETS, agree, noise, solve

import prdp_torch as prdp
from prdp_torch import operators

TEAMS = {"cells": 48}  # a few blocks for a sample


def jumps(*shape, dtype, samples=3):
    """κ of boxes, a thousand times larger within."""
    kappa = torch.ones(samples, *shape, dtype=dtype)
    for s in range(samples):
        kappa[(s, *(slice(n // 4 + s, n // 2 + s) for n in shape))] = 1e3
    return kappa


def winds(dtype, samples=3):
    """Upwind differences of winds that change their direction, on a line and round a ring; not symmetric."""
    x = torch.linspace(0.0, 6.0, 11, dtype=dtype)
    w = torch.stack([3.0 * torch.sin(x + s) for s in range(samples)])[:, None, :].expand(samples, 9, 11)
    c = torch.zeros(samples, 5, 9, 11, dtype=dtype)
    c[:, 1], c[:, 2] = -1.0 - w.clamp(min=0.0), -1.0 + w.clamp(max=0.0)
    c[:, 3], c[:, 4] = -1.5, -0.5
    c[:, 0] = 0.2 - c[:, 1:].sum(1)
    return c


def ring(dtype):
    """-L round both axes, of an odd number of points and of an even one."""
    return torch.tensor([4.0, -1.0, -1.0, -1.0, -1.0], dtype=dtype).view(1, 5, 1, 1).expand(1, 5, 9, 10).contiguous()


OPERATORS = {  # with the shape of a sample
    "heat": (lambda t: operators.Heat((13, 10), torch.tensor(0.5, dtype=t), 1.0), (1, 13, 10)),
    "line": (lambda t: operators.Poisson((37,)), (1, 37)),
    "poisson 3D": (lambda t: operators.Poisson((5, 6, 7)), (1, 5, 6, 7)),
    "jumps": (lambda t: operators.Diffusion(jumps(12, 9, dtype=t), shift=0.1), (1, 12, 9)),
    "jumps 3D": (
        lambda t: operators.Diffusion(jumps(4, 5, 7, dtype=t), shift=0.1, boundary=("flux", "periodic", "zero")),
        (1, 4, 5, 7),
    ),
    "thin": (lambda t: operators.Diffusion(torch.ones(1, 3, 14, dtype=t), length=(0.01, 1.0), shift=1.0), (2, 3, 14)),
    "flat": (
        lambda t: operators.Diffusion(torch.ones(1, 3, 14, dtype=t), length=(0.01, 1.0), shift=1.0, boundary="flux"),
        (2, 3, 14),
    ),
    "winds": (lambda t: operators.Stencil(winds(t), OFFSETS, ("periodic", "zero")), (2, 9, 11)),
    "burgers": (lambda t: operators.Burgers(noise(3, 2, 9, 10, dtype=t), 0.05, 0.5), (2, 9, 10)),
    "burgers 1D": (lambda t: operators.Burgers(noise(1, 1, 21, dtype=t), 0.05, 0.5), (1, 21)),
    "ring": (lambda t: operators.Stencil(ring(t), OFFSETS, "periodic", nullspace="constant"), (2, 9, 10)),
    "closed": (lambda t: operators.Diffusion(jumps(7, 11, dtype=t), boundary="flux"), (1, 7, 11)),
}  # fmt: skip
SINGULAR = ["ring", "closed"]
SYMMETRIC = ["heat", "line", "poisson 3D", "jumps", "jumps 3D", "thin", "flat", *SINGULAR]


def right_hand_sides(name, dtype, samples=3):
    b = noise(samples, *OPERATORS[name][1], seed=3)
    if name in SINGULAR:
        b -= b.mean(tuple(range(2, b.dim())), keepdim=True)
    return b.to(dtype)


def with_cycles(method, **settings):
    if method is prdp.Multigrid:
        return prdp.Multigrid(**settings)
    if method is prdp.GMRES:
        settings["restart"] = 6
    return method(preconditioner="multigrid", **settings)


CASES = [(name, method) for name in OPERATORS for method in (prdp.Multigrid, prdp.GMRES, prdp.BiCGStab)]
CASES += [(name, method) for name in SYMMETRIC for method in (prdp.CG, prdp.MINRES)]
# The cheap half of them is enough for each operator to meet each way, and each method each dtype.
CASES = [case for n, case in enumerate(CASES) if n % 2 == 0 or case[1] is prdp.CG]


@pytest.mark.parametrize("name, method, dtype", [(*case, (F32, F64)[n % 2]) for n, case in enumerate(CASES)])
def test_cycles_are_those_of_the_cpu(name, method, dtype):
    a, b = OPERATORS[name][0](dtype), right_hand_sides(name, dtype)
    rtol = 1e-4 if dtype == F32 else 1e-10
    solver = with_cycles(method, max_iter=60, rtol=rtol)
    mine, other = (solve(a, b, solver, device) for device in ({}, None))
    agree(mine, other, dtype, slack=10 * rtol / torch.finfo(dtype).eps)
    few = with_cycles(method, max_iter=2, rtol=0.0)
    agree(solve(a, b, few, TEAMS), solve(a, b, few), dtype, slack=1e4)


@pytest.mark.parametrize("name", ["jumps", "winds", "burgers", "ring"])
@pytest.mark.parametrize("device", [{}, TEAMS, {"block_memory": 0}], ids=["block", "team", "outside"])
def test_bits_depend_neither_on_the_order_of_threads_nor_on_neighbours(name, device):
    a, b = OPERATORS[name][0](F32), right_hand_sides(name, F32)
    solver = with_cycles(prdp.GMRES, max_iter=1, rtol=0.0)
    wanted, report = solve(a, b, solver, device)
    for order in (BACKWARD, SHUFFLED):
        u, info = solve(a, b, solver, {**device, "order": order})
        assert torch.equal(u, wanted) and torch.equal(info.residual, report.residual)
    lone = {
        "jumps": lambda: operators.Diffusion(jumps(12, 9, dtype=F32)[1:2], shift=0.1),
        "winds": lambda: operators.Stencil(winds(F32)[1:2], OFFSETS, ("periodic", "zero")),
        "burgers": lambda: operators.Burgers(noise(3, 2, 9, 10, dtype=F32)[1:2], 0.05, 0.5),
    }.get(name, lambda: a)()
    assert torch.equal(solve(lone, b[1:2], solver, device)[0][0], wanted[1])
