"""Operators with right-hand sides, at chosen distances from trouble."""

import math

import torch

from prdp_torch import fields, operators
from prdp_torch.experiments import _C

SEED = 0
SAMPLES = 16


def noise(*shape, dtype=torch.float64, seed=SEED):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def heat(ratio, n=64, dtype=torch.float64, batch=SAMPLES):
    """A heat step with ratio = nu dt/dx², and random states."""
    return operators.Heat((n,), ratio / (n + 1) ** 2, 1.0), noise(batch, 1, n, dtype=dtype)


def burgers(cfl, n=64, batch=SAMPLES, dtype=torch.float64, smooth=False):
    """A Burgers step with cfl = dt max|u|/dx about random states with max|u| = 1 (nu = 1e-3), and those states."""
    u = noise(batch, 1, n)
    if smooth:
        u = torch.fft.irfft(torch.fft.rfft(u)[..., :6], n=n)
    u = (u / u.abs().amax(2, keepdim=True)).to(dtype)
    return operators.Burgers(u, 1e-3, cfl / n), u


def burgers_of_amplitude(peclet, ratio=10.0, n=64):
    """A Burgers step with ratio = nu dt/dx² about random states with max|u| dx/nu = peclet (nu = 1e-3), and those
    states. Heat is the limit of small ones."""
    _, u = burgers(1.0, n)
    u = peclet * 1e-3 * n * u
    return operators.Burgers(u, 1e-3, ratio / (1e-3 * n**2)), u


def flow(cfl, n=16, batch=8, dtype=torch.float64):
    """A Navier-Stokes step with cfl = dt max|u|/dx about random solenoidal velocities (nu = 1e-3)."""
    return _flow_step(noise(batch, 3, n, n), cfl / n, dtype)


def flow_of_size(n, dt=0.1, batch=4):
    """A Navier-Stokes step about smooth random velocities with max|u| = 1 (nu = 1e-3), the same dt on all grids."""
    modes = (torch.fft.fftfreq(n, 1 / n).abs()[:, None] <= 3) & (torch.fft.rfftfreq(n, 1 / n) <= 3)
    return _flow_step(torch.fft.irfft2(torch.fft.rfft2(noise(batch, 3, n, n)) * modes, s=(n, n)), dt)


def _flow_step(velocities, dt, dtype=torch.float64):
    """Its operator and right-hand side, about these velocities without their divergence and scaled to max|u| = 1."""
    u = fields.project(velocities)
    u = (u / u[:, :2].abs().amax((1, 2, 3), keepdim=True)).to(dtype)
    b = u / dt
    b[:, 2] = 0.0
    return operators.NavierStokes(u, 1e-3, dt), b


def diffusion(contrast, n=32, ratio=10.0, batch=4, dtype=torch.float64):
    """A step of u_t = ∇·(κ ∇u) with a κ that is random from cell to cell: max κ/min κ = contrast, and κ dt/dx² = ratio
    in between, the geometric mean of the two."""
    g = torch.rand(n, n, generator=torch.Generator().manual_seed(SEED), dtype=torch.float64)
    g = (g - g.min()) / (g.max() - g.min()) - 0.5
    kappa = ratio / n**2 * torch.exp(math.log(contrast) * g)
    coefficients, offsets = _C.diffusion_stencil(kappa.to(dtype), 1.0)
    return operators.Stencil(coefficients, offsets, "periodic"), noise(batch, 1, n, n, dtype=dtype)


def hyperdiffusion(ratio, n=32, batch=SAMPLES, dtype=torch.float64):
    """A step of u_t = -nu u_xxxx with ratio = nu dt/dx⁴ on a periodic grid. Jacobi's spectral radius is
    10 ratio/(1 + 6 ratio): it converges for ratio < 1/4 alone."""
    c = torch.tensor([1 + 6 * ratio, -4 * ratio, -4 * ratio, ratio, ratio], dtype=dtype)
    stencil = c.view(1, 5, 1).expand(1, 5, n)
    return operators.Stencil(stencil, [(0,), (-1,), (1,), (-2,), (2,)], "periodic"), noise(batch, 1, n, dtype=dtype)


def matrices():
    """Small systems with known outcomes: name → (A, b)."""
    eye, f64 = torch.eye(8, dtype=torch.float64), torch.float64
    shift = eye.roll(1, 1)
    first = eye[0]
    singular = torch.ones(2, 2, dtype=f64)
    laplacian = (
        2 * torch.eye(16, dtype=f64) - torch.eye(16, dtype=f64).roll(1, 0) - torch.eye(16, dtype=f64).roll(-1, 0)
    )
    rough = noise(16)
    biharmonic, _ = hyperdiffusion(1.0, n=16)
    upwind, wind = burgers(100.0, n=16, batch=1)
    return {
        "swap [[0, 1], [1, 0]]": (eye[:2, :2].flip(0), first[:2]),
        "cyclic shift of 8": (shift, first),
        "0.1 I + 0.9 · ones(3)": (0.1 * eye[:3, :3] + 0.9, torch.tensor([1.0, 2.0, 3.0], dtype=f64)),
        "singular, b in the range": (singular, torch.ones(2, dtype=f64)),
        "singular, b outside": (singular, torch.tensor([1.0, 2.0], dtype=f64)),
        "periodic Laplacian, b mean-free": (laplacian, rough - rough.mean()),
        "1 + Δ² (periodic)": (biharmonic.dense(f64), rough),
        "Burgers, CFL 100": (upwind.dense(f64), wind.flatten()),
        "saddle point [[1, 1], [1, 0]]": (torch.tensor([[1.0, 1.0], [1.0, 0.0]], dtype=f64), first[:2]),
    }
