"""The systems that are solved: one implicit step of each equation of the paper and of a diffusion with a field of
coefficients, from smooth random states."""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch

import prdp_torch as prdp
from prdp_torch import fields, operators
from prdp_torch.experiments import _C

SMOOTHING = 3e-3  # nu dt of the heat step that turns noise into a state


@dataclass
class Problem:
    """A u = b for a batch, and the gradient of a loss gᵀu: λ with Aᵀλ = g, that for b; where A is made of a field κ,
    the pair of it and that for κ."""

    name: str
    title: str
    operator: operators.Operator
    b: torch.Tensor
    g: torch.Tensor
    solver: callable  # K to the paper's solver with K iterations and no tolerance
    k: int  # the paper's, or performance figures', K
    nu: float
    dt: float
    winds: torch.Tensor | None = None
    kappa: torch.Tensor | None = None

    @property
    def shape(self):
        return tuple(self.b.shape[2:])

    @property
    def unknowns(self):
        """Of one sample."""
        return self.b[0].numel()

    @cached_property
    def exact(self):
        """(u, gradient) in float64 by the direct solver."""
        leaves = self.leaves(torch.float64)
        u, _ = prdp.linear_solve(self.operator_of(*leaves), leaves[0], prdp.Direct(2))
        u.backward(self.g.double())
        return u.detach(), gradient_of(*leaves)

    def leaves(self, dtype=torch.float32):
        """[b], or [b, κ], to be differentiated for."""
        of = [self.b] if self.kappa is None else [self.b, self.kappa]
        return [t.to(dtype, copy=True).requires_grad_() for t in of]

    def operator_of(self, b, kappa=None):
        """The operator that belongs to leaves."""
        return make_operator(self, b.dtype) if kappa is None else diffusion_operator(kappa, self.dt)

    def errors(self, u, gradient=None):
        """Largest over the batch: the true residual of u and the error of the gradient, both relative.
        Arrays of any library, of any shape with the right number of values."""
        u = as_double(u).reshape(self.b.shape)
        b = self.b.double()
        residual = largest(b - make_operator(self, torch.float64).apply(u), b)
        if gradient is None:
            return residual, None
        found, exact = ([one] if self.kappa is None else one for one in (gradient, self.exact[1]))
        pairs = [(as_double(f).reshape(e.shape), e) for f, e in zip(found, exact, strict=True)]
        return residual, max(largest(f - e, e) for f, e in pairs)


def gradient_of(b, kappa=None):
    return b.grad if kappa is None else (b.grad, kappa.grad)


def as_double(array):
    """An array of any library, on the CPU."""
    return (array.cpu() if isinstance(array, torch.Tensor) else torch.tensor(np.asarray(array))).double()


def largest(error, of):
    """Over the batch; a field without one, (Ny, Nx), counts as a single sample."""
    error, of = (t if t.dim() > 2 else t[None] for t in (error, of))
    return float((error.flatten(1).norm(dim=1) / of.flatten(1).norm(dim=1)).max())


def make_operator(problem, dtype):
    if problem.kappa is not None:
        return diffusion_operator(problem.kappa.to(dtype), problem.dt)
    winds = None if problem.winds is None else problem.winds.to(dtype)
    return _operator(problem.name, problem.shape, problem.nu, problem.dt, winds)


def _operator(name, shape, nu, dt, winds):
    if name.startswith("heat"):
        return operators.Heat(shape, nu, dt)
    return (operators.Burgers if name.startswith("burgers") else operators.NavierStokes)(winds, nu, dt)


def diffusion_operator(kappa, dt):
    """I - dt ∇·(κ ∇) on a periodic grid, κ (Ny, Nx) at its points."""
    return operators.Stencil(*_C.diffusion_stencil(kappa, dt), "periodic")


def smooth_states(shape, batch, channels=1, seed=0):
    """Normal noise through one implicit heat step, each channel of a sample scaled to unit deviation."""
    noise = torch.randn(batch * channels, 1, *shape, generator=torch.Generator().manual_seed(seed))
    smooth = prdp.Heat(shape, SMOOTHING, 1.0, solver=prdp.Direct())(noise).reshape(batch, channels, *shape)
    return smooth / smooth.flatten(2).std(dim=2).reshape(batch, channels, *(1 for _ in shape))


def heat(shape, k, batch=25, nu=1e-3, dt=1.0):
    b, g = smooth_states(shape, batch), smooth_states(shape, batch, seed=1)
    name = f"heat_{len(shape)}d"
    extents = " × ".join(map(str, shape))
    return Problem(
        name, f"heat {len(shape)}D, {extents}", _operator(name, shape, nu, dt, None), b, g,
        lambda k: prdp.Jacobi(k, rtol=0.0), k, nu, dt,
    )  # fmt: skip


def burgers(shape=(256,), k=23, batch=25, nu=1e-3, dt=0.01):
    u, g = (smooth_states(shape, batch, len(shape), seed) for seed in (0, 1))
    name = f"burgers_{len(shape)}d"
    return Problem(
        name, f"Burgers {len(shape)}D, {shape[0]}", _operator(name, shape, nu, dt, u), u, g,
        lambda k: prdp.GMRES(k, rtol=0.0, restart=2), k, nu, dt, u,
    )  # fmt: skip


def navier_stokes(shape=(48, 48), k=15, batch=25, nu=1e-4, dt=0.1):
    u, g = (fields.project(smooth_states(shape, batch, 3, seed)) for seed in (0, 1))
    g = g.clone()
    g[:, 2] -= g[:, 2].mean((-2, -1), keepdim=True)  # a cotangent that a loss without mean pressure gives
    b = prdp.NavierStokes(shape, nu, dt, solver=prdp.Direct()).rhs(u)
    return Problem(
        "navier_stokes", f"Navier–Stokes, {shape[0]} × {shape[1]}", operators.NavierStokes(u, nu, dt), b, g,
        lambda k: prdp.GMRES(k, rtol=0.0, restart=8), k, nu, dt, u,
    )  # fmt: skip


def diffusion(shape, k, batch=25, mean=0.01, contrast=1.0, dt=0.01):
    """κ = mean·exp(contrast·s) with s of unit deviation, one field for all samples."""
    b, g = smooth_states(shape, batch), smooth_states(shape, batch, seed=1)
    kappa = mean * torch.exp(contrast * smooth_states(shape, 1, seed=2)[0, 0])
    return Problem(
        f"diffusion_{shape[0]}", f"variable diffusion, {shape[0]} × {shape[1]}", diffusion_operator(kappa, dt), b, g,
        lambda k: prdp.CG(k, rtol=0.0), k, mean, dt, kappa=kappa,
    )  # fmt: skip


PROBLEMS = {
    "heat_1d": partial(heat, (30,), 25),
    "heat_2d": partial(heat, (30, 30), 43),
    "heat_3d": partial(heat, (20, 20, 20), 50),
    "burgers_1d": burgers,
    "navier_stokes": navier_stokes,
}
DIFFUSION = {
    "diffusion_64": lambda: diffusion((64, 64), 40),
    "diffusion_256": lambda: diffusion((256, 256), 150),
}
