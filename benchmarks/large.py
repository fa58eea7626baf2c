"""Large grids: seconds and errors of one elliptic solve against the number of unknowns, to two million, with what users
would take instead: conjugate gradients of SciPy's kind, a sparse LU, algebraic multigrid of an assembled matrix."""

import importlib.util
import math
import time

import numpy as np
import torch

import prdp_torch as prdp
from benchmarks import measure, volumes
from prdp_torch import _C
from prdp_torch.operators import Diffusion, Poisson

SIDES = (63, 127, 255, 511, 1023)
CUBES = (63, 127)
CONTRAST = 800.0
RTOL = 1e-5
PATIENCE = 60.0  # seconds a solve may have taken on the grid before
TWO = ", two threads"
MULTIGRID = prdp.CG(50, RTOL, preconditioner="multigrid")
OF_CUBES = {
    "CG": prdp.CG(30000, RTOL),
    "Chebyshev": prdp.Chebyshev(30000, RTOL),
    "CG, multigrid": MULTIGRID,
    "direct": prdp.Direct(),
}


def run(report, quick=False):
    """[{solver, grid, unknowns, seconds, again, iterations, residual, status}]: a first solve, with what it needs to
    set up, and one more with the same κ. The residual is that of u in float64."""
    points, too_slow = [], set()
    for side in SIDES[: 2 if quick else None]:
        kappa, b = problem(side)
        for name, prepared in solvers().items():
            if name in too_slow:
                continue
            report(f"large: {side}², {name}")
            calls = {label: prepare(kappa, b) for label, prepare in prepared.items()}
            found = timed(calls, lambda u, kappa=kappa, b=b: residual(Diffusion(kappa), b, u))
            points += [{"grid": f"{side}²", "unknowns": side**2, **point} for point in found]
            # CG: four times the unknowns, twice the iterations, out of the cache
            if max(max(point["seconds"], point["again"]) for point in found) * 16 > PATIENCE:
                too_slow.add(name)
    for side in CUBES[: 1 if quick else None]:
        b = torch.tensor(np.random.default_rng(1).standard_normal((1, 1, side, side, side)))
        operator = Poisson((side,) * 3)
        for name, solver in OF_CUBES.items():
            report(f"large: {side}³, {name}")
            calls = {
                name + TWO * (threads == 2): call(lambda operator=operator: operator, b.float(), solver, threads)
                for threads in (1, 2)
            }
            found = timed(calls, lambda u, b=b, operator=operator: residual(operator, b, u))
            points += [{"grid": f"{side}³", "unknowns": side**3, **point} for point in found]
    return points


def timed(calls, residual):
    """The seconds of a first call of each with what it found, and of further ones, all in turn: the fastest of five
    rounds, or of those that fit into a second."""
    points = []
    for label, solve in calls.items():
        _C.clear_factorisations()
        started = time.perf_counter()
        u, iterations, status = solve()
        seconds = time.perf_counter() - started
        points.append({"solver": label, "seconds": seconds, "again": math.inf, "iterations": iterations,
                       "residual": residual(u), "status": status})  # fmt: skip
    began = time.perf_counter()
    for rounds in range(5):
        if rounds and time.perf_counter() - began > len(calls):
            break
        for point, solve in zip(points, calls.values(), strict=True):
            started = time.perf_counter()
            solve()
            point["again"] = min(point["again"], time.perf_counter() - started)
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


def residual(operator, b, u):
    left = b - operator.apply(torch.as_tensor(u, dtype=torch.float64).reshape(b.shape))
    return float(left.norm() / b.norm())


def solvers():
    """{name: {label: prepare}}: what is timed in turn; prepare(κ, b) gives a call that returns u, the iterations and
    the status."""
    plain, gradients = prdp.CG(30000, RTOL), "CG, multigrid, with the gradients for b and κ"
    found = {
        "CG": {"CG": ours(plain), "CG, two threads": ours(plain, threads=2)},
        "CG, diagonal": {"CG, diagonal": ours(prdp.CG(30000, RTOL, preconditioner="diagonal"))},
        "CG, multigrid": {
            "CG, multigrid": ours(MULTIGRID),
            "CG, multigrid, two threads": ours(MULTIGRID, threads=2),
            gradients: ours(MULTIGRID, gradient=True),
            f"{gradients}, two threads": ours(MULTIGRID, threads=2, gradient=True),
        },
        "Multigrid": {
            "Multigrid": ours(prdp.Multigrid(50, RTOL)),
            "Multigrid, two threads": ours(prdp.Multigrid(50, RTOL), threads=2),
        },
        "direct": {"direct": ours(prdp.Direct())},
    }
    if importlib.util.find_spec("scipy"):
        found["SciPy LU"] = {"SciPy LU": scipy_lu}
    if importlib.util.find_spec("pyamg"):
        for label, name in (
            ("pyamg, Ruge–Stüben and CG", "ruge_stuben_solver"),
            ("pyamg, smoothed aggregation and CG", "smoothed_aggregation_solver"),
        ):
            found[label] = {label: pyamg_with(name)}
    return found


def ours(solver, threads=1, gradient=False):
    def prepare(kappa, b):
        kappa, b = (t.float().requires_grad_(gradient) for t in (kappa, b))
        return call(lambda: Diffusion(kappa), b, solver, threads)

    return prepare


def call(operator, b, solver, threads):
    """A call that solves, with the gradients of whatever needs one."""

    def solve():
        with measure.threads(threads):
            u, info = prdp.linear_solve(operator(), b, solver, on_failure="return")
            if u.requires_grad:
                u.square().sum().backward()
        return u.detach(), int(info.iterations), prdp.SolveStatus(int(info.status)).name

    return solve


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
