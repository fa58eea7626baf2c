"""Solves of kernels on the fibers, under ThreadSanitizer: `python races.py LEFT_OUT`, the line of a barrier or 0. The
library of the sanitizer is preloaded; the compiler of the kernels must not get it."""

import os
import sys

os.environ.pop("LD_PRELOAD", None)

import test_gpu_multigrid as multigrid
import torch
from fibers import Fibers
from test_gpu_kernels import OPERATORS, right_hand_sides, solver

import prdp_torch as prdp


def main():
    for name, method in (("heat 2D", prdp.CG), ("diffusion", prdp.GMRES), ("closed", prdp.CG)):
        a, b = OPERATORS[name](torch.float32), right_hand_sides(name, torch.float32)
        few = solver(method, rtol=0.0, max_iter=2)
        with Fibers(left_out=int(sys.argv[1]), block_memory=0):
            prdp.linear_solve(a, b, solver=few, on_failure="return")
    for name in ("ring", "navier-stokes"):
        a, b = multigrid.OPERATORS[name][0](torch.float32), multigrid.right_hand_sides(name, torch.float32)
        with Fibers(left_out=int(sys.argv[1]), block_memory=0):
            prdp.linear_solve(a, b, multigrid.with_cycles(prdp.GMRES, max_iter=1, rtol=0.0), on_failure="return")
    flow = prdp.Flow((5, 6), nu=0.1, dt=0.01, solver=prdp.CG(2, 0.0), on_failure="return")
    with Fibers(left_out=int(sys.argv[1])):
        u = torch.randn(2, 2, 5, 6, requires_grad=True)
        torch.autograd.grad(flow(u).square().sum(), u)
    kappa = torch.ones(3, 6, 7, requires_grad=True)
    with Fibers(left_out=int(sys.argv[1]), threads=32):
        a, b = prdp.operators.Diffusion(kappa, 1.0), right_hand_sides("diffusion", torch.float32)
        u, _ = prdp.linear_solve(a, b, prdp.CG(2, 0.0), on_failure="return")
        torch.autograd.grad(u.square().sum(), kappa)


if __name__ == "__main__":
    main()
