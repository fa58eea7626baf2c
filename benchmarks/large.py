"""Large grids: seconds and errors of one elliptic solve against the number of unknowns, to a million, with what users
would take instead: conjugate gradients of SciPy's kind, a sparse LU, algebraic multigrid of an assembled matrix."""

import importlib.util
import time

import numpy as np
import torch

import prdp_torch as prdp
from benchmarks import volumes
from prdp_torch import _C
from prdp_torch.operators import Diffusion

SIDES = (63, 127, 255, 511, 1023)
CONTRAST = 800.0
RTOL = 1e-5
PATIENCE = 60.0  # seconds a solve may have taken on the grid before


def run(report, quick=False):
    """[{solver, side, unknowns, seconds, again, iterations, residual, status}]: a first solve, with what it needs to
    set up, and one more with the same κ. The residual is that of u in float64."""
    points, too_slow = [], set()
    for side in SIDES[: 2 if quick else None]:
        kappa, b = problem(side)
        for name, prepare in solvers().items():
            if name in too_slow:
                continue
            report(f"large: {side}², {name}")
            solve = prepare(kappa, b)
            started = time.perf_counter()
            u, iterations, status = solve()
            first = time.perf_counter() - started
            started = time.perf_counter()
            solve()
            again = time.perf_counter() - started
            if max(first, again) * 16 > PATIENCE:  # CG: four times the unknowns, twice the iterations, out of the cache
                too_slow.add(name)
            points.append({
                "solver": name, "side": side, "unknowns": side**2, "seconds": first, "again": again,
                "iterations": iterations, "residual": residual(kappa, b, u), "status": status,
            })  # fmt: skip
    return points


def problem(side):
    """κ smooth with a contrast of 800, and white noise."""
    noise = np.random.default_rng(1)
    y, x = np.meshgrid(*[np.arange(side) / side] * 2, indexing="ij")
    waves = np.zeros((side, side))
    for _ in range(12):
        ky, kx = noise.integers(-6, 7, 2)
        waves += noise.standard_normal() * np.sin(2 * np.pi * (ky * y + kx * x) + 6 * noise.random())
    waves = (waves - waves.min()) / (waves.max() - waves.min())
    kappa = torch.tensor(CONTRAST**waves)[None]
    return kappa, torch.tensor(noise.standard_normal((1, 1, side, side)))


def residual(kappa, b, u):
    left = b - Diffusion(kappa).apply(torch.as_tensor(u, dtype=torch.float64).reshape(b.shape))
    return float(left.norm() / b.norm())


def solvers():
    """{name: prepare}; prepare(κ, b) gives a call that returns u, the iterations and the status."""
    found = {
        "CG": ours(prdp.CG(30000, RTOL)),
        "CG, diagonal": ours(prdp.CG(30000, RTOL, preconditioner="diagonal")),
        "CG, multigrid": ours(prdp.CG(50, RTOL, preconditioner="multigrid")),
        "Multigrid": ours(prdp.Multigrid(50, RTOL)),
        "direct": ours(prdp.Direct()),
    }
    if importlib.util.find_spec("scipy"):
        found["SciPy LU"] = scipy_lu
    if importlib.util.find_spec("pyamg"):
        found["pyamg, Ruge–Stüben and CG"] = pyamg_with("ruge_stuben_solver")
        found["pyamg, smoothed aggregation and CG"] = pyamg_with("smoothed_aggregation_solver")
    return found


def ours(solver):
    def prepare(kappa, b):
        kappa, b = kappa.float(), b.float()
        _C.clear_factorisations()

        def solve():
            with torch.no_grad():
                u, info = prdp.linear_solve(Diffusion(kappa), b, solver, on_failure="return")
            return u, int(info.iterations), prdp.SolveStatus(int(info.status)).name

        return solve

    return prepare


def assembled(kappa):
    """The matrix of `Diffusion`, float64."""
    import scipy.sparse

    k = kappa[0].numpy()
    cells = np.arange(k.size).reshape(k.shape)
    held = np.concatenate([cells[0], cells[-1], cells[:, 0], cells[:, -1]])
    return len(k) ** 2 * scipy.sparse.csr_matrix(volumes.entries(k.ravel(), volumes.neighbours(cells), held))


def scipy_lu(kappa, b):
    from scipy.sparse.linalg import splu

    matrix, rhs, factors = assembled(kappa).tocsc(), b.numpy().ravel(), []

    def solve():
        if not factors:
            factors.append(splu(matrix))
        return factors[0].solve(rhs), 1, ""

    return solve


def pyamg_with(name):
    def prepare(kappa, b):
        import pyamg

        matrix, rhs, made = assembled(kappa), b.numpy().ravel(), []
        matrix.indices, matrix.indptr = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)

        def solve():
            if not made:
                made.append(getattr(pyamg, name)(matrix))
            residuals = []
            u = made[0].solve(rhs, tol=RTOL, accel="cg", maxiter=200, residuals=residuals)
            return u, len(residuals) - 1, ""

        return solve

    return prepare
