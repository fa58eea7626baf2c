"""Plain torch: the same iterations as batched tensor operations, implicit derivative by a second solve."""

import torch

from benchmarks import ours
from benchmarks.peers import stencils


class Backend:
    stack = staticmethod(torch.stack)

    @staticmethod
    def roll(v, shift, axis):
        return torch.roll(v, shift, axis)

    @staticmethod
    def pad(v, axis):
        return torch.nn.functional.pad(v, [0, 0] * (-axis - 1) + [1, 1])


def jacobi(stencil, transposed, b, k):
    scale = 1 / stencil.diagonal
    u = b * scale
    for _ in range(k - 1):
        u = (b - stencil.off_diagonal(u)) * scale
    return u


def gmres(stencil, transposed, b, cycles, m):
    """GMRES(m), one Gram–Schmidt pass, least squares by QR; as many products as ours."""
    apply = stencil.transpose if transposed else stencil.apply
    batch = len(b)
    x, r = torch.zeros_like(b), b
    basis = b.new_empty(batch, m + 1, b[0].numel())
    for cycle in range(cycles):
        if cycle:
            r = b - apply(x)
        size = r.flatten(1).norm(dim=1)
        basis[:, 0] = r.flatten(1) / size[:, None]
        h = b.new_zeros(batch, m + 1, m)
        for j in range(m):
            w = apply(basis[:, j].view(b.shape)).flatten(1)
            dots = torch.bmm(basis[:, : j + 1], w[:, :, None])
            w = torch.baddbmm(w[:, None], dots.mT, basis[:, : j + 1], alpha=-1)[:, 0]
            h[:, : j + 1, j], h[:, j + 1, j] = dots[:, :, 0], w.norm(dim=1)
            basis[:, j + 1] = w / h[:, j + 1, j, None]
        q, triangle = torch.linalg.qr(h)
        y = torch.linalg.solve_triangular(triangle, q.mT[:, :, :1] * size[:, None, None], upper=True)
        x = x + torch.bmm(y.mT, basis[:, :m]).view(b.shape)
    return x


class Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx, b, solve):
        ctx.solve = solve
        return solve(b, False)

    @staticmethod
    def backward(ctx, g):
        return ctx.solve(g, True), None


def calls(problem, solve):
    leaf = problem.b.clone().requires_grad_()

    def forward():
        with torch.no_grad():
            return solve(problem.b, False)

    def both():
        leaf.grad = None
        u = Implicit.apply(leaf, solve)
        u.backward(problem.g)
        return u.detach(), leaf.grad

    return forward, both


def entries(problem):
    stencil = stencils.make(problem, Backend, torch.from_numpy)
    if problem.name.startswith("heat"):
        loop, label, extra = jacobi, "Jacobi", ()
    else:
        m = problem.solver(1).restart
        loop, label, extra = gmres, f"GMRES({m})", (m,)

    def prepare(k):
        return calls(problem, lambda b, transposed: loop(stencil, transposed, b, k, *extra))

    yield ours.Entry(f"torch eager, {label}", "implicit", [problem.k], prepare, same_as=label)
