"""Plain torch: the same iterations as batched tensor operations, implicit derivative by a second solve."""

import importlib.util
import warnings
from functools import partial

import torch

from benchmarks.entries import Entry
from benchmarks.peers import stencils
from benchmarks.problems import gradient_of


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


def cg(stencil, transposed, b, k):
    """Of a symmetric operator."""
    x, r, p = torch.zeros_like(b), b, b
    rr = dots(r, r)
    for _ in range(k):
        q = stencil.apply(p)
        alpha = rr / dots(p, q)
        x, r = x + alpha * p, r - alpha * q
        rr, before = dots(r, r), rr
        p = r + rr / before * p
    return x


def dots(v, w):
    return (v * w).sum(tuple(range(1, v.dim())), keepdim=True)


class Sparse:
    """A stencil as a CSR matrix; its values get no gradient, which would be a dense matrix in torch."""

    def __init__(self, problem):
        from benchmarks.peers.scipy_direct import matrices

        (matrix,) = (m.tocsr().astype("float32") for m in matrices(problem))
        with warnings.catch_warnings(action="ignore"):  # torch calls its CSR tensors a beta
            self.matrix = torch.sparse_csr_tensor(
                torch.from_numpy(matrix.indptr), torch.from_numpy(matrix.indices), torch.from_numpy(matrix.data),
                matrix.shape,
            )  # fmt: skip

    def apply(self, v):
        return (self.matrix @ v.flatten(1).mT).mT.reshape(v.shape)


class Implicit(torch.autograd.Function):
    @staticmethod
    def forward(ctx, b, solve):
        ctx.solve = solve
        return solve(b, False)

    @staticmethod
    def backward(ctx, g):
        return ctx.solve(g, True), None


class ImplicitDiffusion(torch.autograd.Function):
    """b̄ = λ, κ̄ = -∂⟨λ, A(κ) u⟩/∂κ."""

    @staticmethod
    def forward(ctx, b, kappa, dt, make, solve):
        ctx.dt, ctx.solve, ctx.stencil = dt, solve, make(kappa)
        u = solve(ctx.stencil, b)
        ctx.save_for_backward(kappa, u)
        return u

    @staticmethod
    def backward(ctx, g):
        kappa, u = ctx.saved_tensors
        found = ctx.solve(ctx.stencil, g)
        with torch.enable_grad():
            leaf = kappa.detach().requires_grad_()
            (bar,) = torch.autograd.grad(stencils.diffusion(leaf, ctx.dt, stencils.TorchBackend).apply(u), leaf, -found)
        return found, bar, None, None, None


def diffusion_calls(problem, make, solve):
    """make(κ): what solve(it, b) takes."""
    leaves = problem.leaves()
    made = make(problem.kappa)

    def forward():
        with torch.no_grad():
            return solve(made, problem.b)

    def both():
        for leaf in leaves:
            leaf.grad = None
        u = ImplicitDiffusion.apply(*leaves, problem.dt, make, solve)
        u.backward(problem.g)
        return u.detach(), gradient_of(*leaves)

    return forward, both


def diffusion_entries(problem):
    def prepare(k, make=lambda kappa: stencils.diffusion(kappa, problem.dt, stencils.TorchBackend)):
        return diffusion_calls(problem, make, lambda stencil, b: cg(stencil, False, b, k))

    yield Entry("torch eager, CG", "implicit", [problem.k], prepare, same_as="CG")
    if importlib.util.find_spec("scipy"):
        matrix = Sparse(problem)
        prepare_sparse = partial(prepare, make=lambda kappa: matrix)
        yield Entry("torch eager CSR, CG", "implicit", [problem.k], prepare_sparse, same_as="CG")


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
    if problem.kappa is not None:
        yield from diffusion_entries(problem)
        return
    stencil = stencils.make(problem, stencils.TorchBackend, torch.from_numpy)
    if problem.name.startswith("heat"):
        loop, label, extra = jacobi, "Jacobi", ()
    else:
        m = problem.solver(1).restart
        loop, label, extra = gmres, f"GMRES({m})", (m,)

    def prepare(k):
        return calls(problem, lambda b, transposed: loop(stencil, transposed, b, k, *extra))

    yield Entry(f"torch eager, {label}", "implicit", [problem.k], prepare, same_as=label)
