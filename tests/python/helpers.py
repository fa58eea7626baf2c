"""What the tests share: independent truths, golden arrays and tables of cases."""

from pathlib import Path

import numpy as np
import pytest
import torch

import prdp_torch as prdp
from prdp_torch.experiments import _C, scenes

DATA = Path(__file__).parents[1] / "data"
ITERATIVE = [prdp.Jacobi, prdp.SteepestDescent, prdp.CG, prdp.BiCGStab, prdp.MINRES, prdp.GMRES]
SOLVERS = [*ITERATIVE, prdp.Direct]
modes = pytest.mark.parametrize("backward", ["implicit", "unrolled"])
TINY = (
    ("shape = [48, 48]", "shape = [8, 8]"),
    ("reference_shape = [97, 97]", "reference_shape = [17, 17]"),
    ("train = 200", "train = 8"),
    ("valid = 5", "valid = 2"),
    ("blocks = 3", "blocks = 1"),
    ("width = 64", "width = 8"),
    ("batch = 25", "batch = 2"),
    ("epochs = 100", "epochs = 5"),
    ("constant = [2, 5, 10, 20]", "constant = [2]"),
)
SMALL_FIELD = (
    ("shape = [64, 64]", "shape = [10, 12]"),
    ("\nstates = 4", "\nstates = 3"),
    ("steps = 20", "steps = 6"),
    ("every = 4", "every = 2"),
    ("updates = 150\nupdates = 150", "updates = 30\nupdates = 30"),
    ("initial = 10", "initial = 2"),
)
SMALL_DARCY = (
    ("shape = [64, 64]", "shape = [10, 12]"),
    ("\nstates = 4", "\nstates = 3"),
    ("updates = 150\nupdates = 150", "updates = 30\nupdates = 30"),
)


def golden(name):
    return np.load(DATA / f"{name}.npz")


def as_toml(content):
    """The text of a scene: plain keys first, then one level of tables."""

    def written(value):
        return str(value).lower() if isinstance(value, bool) else repr(value)

    lines = [f"{name} = {written(value)}" for name, value in content.items() if not isinstance(value, dict)]
    for name, table in content.items():
        if isinstance(table, dict):
            lines += [f"[{name}]", *(f"{key} = {written(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def heat_step(max_iter=1, **options):
    return prdp.Heat((30,), 1e-3, 1.0, solver=prdp.Jacobi(max_iter), **options)


def statuses(info):
    return [prdp.SolveStatus(int(s)).name for s in info.status]


def field(shape, batch=2, seed=0, dtype=torch.float64, channels=1):
    """Random (batch, channels, *shape)."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, channels, *shape, generator=generator, dtype=dtype)


def random(*shape, seed=0, dtype=torch.float64):
    """Random numbers in this shape, the same in every dtype but for their rounding."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)


def dense_laplacian(shape):
    """The Dirichlet Laplacian as a matrix, by Kronecker sums of 1D matrices in numpy."""
    total = np.zeros((1, 1))
    for n in shape:
        second = (np.diag(np.full(n, -2.0)) + np.eye(n, k=1) + np.eye(n, k=-1)) * (n + 1) ** 2
        total = np.kron(total, np.eye(n)) + np.kron(np.eye(len(total)), second)
    return total


def dense_heat(shape, nu=1e-3, dt=1.0):
    laplacian = dense_laplacian(shape)
    return np.eye(len(laplacian)) - nu * dt * laplacian


def spd_matrices(batch, n, seed=0, dtype=torch.float64):
    """Random well-conditioned symmetric positive definite matrices (batch, n, n), diagonally dominant."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(batch, n, n, generator=generator, dtype=dtype)
    a = 0.5 * (a + a.mT)
    return a + 1.5 * torch.diag_embed(a.abs().sum(-1))


def advection_diffusion(shape, nu, faces):
    """Γ - ν L as a matrix, entry by entry; `faces(point, axis, lower, upper)` gives the winds at the
    lower and the upper face of a point that has these neighbours."""
    row = np.arange(np.prod(shape)).reshape(shape)
    c = np.zeros((row.size, row.size))
    for point in np.ndindex(*shape):
        for d, n in enumerate(shape):
            lower, upper = (tuple(np.add(point, s * np.eye(len(shape), dtype=int)[d]) % shape) for s in (-1, 1))
            below, above = faces(point, d, lower, upper)
            c[row[point], row[lower]] -= n * max(below, 0) + nu * n**2
            c[row[point], row[upper]] += n * min(above, 0) - nu * n**2
            c[row[point], row[point]] += n * max(below, 0) - n * min(above, 0) + 2 * nu * n**2
    return c


def dense_burgers(winds, nu, dt):
    """The matrix of one Burgers step from `winds` (dim, *shape), in numpy."""
    dim, *shape = winds.shape

    def faces(point, axis, lower, upper):
        w = winds[dim - 1 - axis]
        return (w[lower] + w[point]) / 2, (w[point] + w[upper]) / 2

    c = advection_diffusion(shape, nu, faces)
    return np.kron(np.eye(dim), np.eye(len(c)) + dt * c)


def dense_navier_stokes(velocity, nu, dt):
    """The matrix of one Navier-Stokes step from `velocity` (2 or 3, Ny, Nx), in numpy."""
    u1, u2 = np.asarray(velocity[:2])
    ny, nx = u1.shape

    def wind_at_u1(point, axis, *_):
        j, i = point
        across = (u2[j, i - 1] + u2[j, i] + u2[(j + 1) % ny, i - 1] + u2[(j + 1) % ny, i]) / 4
        return (u1[point] if axis == 1 else across,) * 2

    def wind_at_u2(point, axis, *_):
        j, i = point
        across = (u1[j - 1, i] + u1[j, i] + u1[j - 1, (i + 1) % nx] + u1[j, (i + 1) % nx]) / 4
        return (u2[point] if axis == 0 else across,) * 2

    c1, c2 = (advection_diffusion((ny, nx), nu, wind) for wind in (wind_at_u1, wind_at_u2))
    one, zero = np.eye(ny * nx), np.zeros((ny * nx, ny * nx))
    d1 = nx * np.kron(np.eye(ny), np.roll(np.eye(nx), 1, axis=1) - np.eye(nx))
    d2 = ny * np.kron(np.roll(np.eye(ny), 1, axis=1) - np.eye(ny), np.eye(nx))
    return np.block([[one / dt + c1, zero, -d1.T], [zero, one / dt + c2, -d2.T], [d1, d2, zero]])


def written(tmp_path, *changes, scene="heat_1d", name="changed"):
    """The path of a copy of a scene with replacements."""
    text = scenes.available()[scene].read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path = tmp_path / f"{name}.toml"
    path.write_text(text)
    return str(path)


def tiny(tmp_path, *changes, name="tiny"):
    """The path of a small copy of the scene navier_stokes, with replacements."""
    return written(tmp_path, *TINY, *changes, scene="navier_stokes", name=name)


def small_field(tmp_path, *changes, name="small"):
    """The path of a small copy of the scene diffusion_inverse, with replacements."""
    return written(tmp_path, *SMALL_FIELD, *changes, scene="diffusion_inverse", name=name)


def small_darcy(tmp_path, *changes, name="small"):
    """The path of a small copy of the scene darcy_inverse, with replacements."""
    return written(tmp_path, *SMALL_DARCY, *changes, scene="darcy_inverse", name=name)


def reseal(path, state):
    """Put another state into a checkpoint, with the fingerprint that belongs to it."""
    mark, settings, _ = path.read_bytes().split(b"\n", 2)
    rest = settings + b"\n" + state
    path.unlink()  # a kill may have left two names with one file
    path.write_bytes(mark.split(b", ")[0] + b", " + _C.fingerprint(rest).encode() + b"\n" + rest)


def line_of(path, text):
    with open(path) as file:
        return next(number for number, line in enumerate(file, 1) if text in line)


def assert_refused(path, where, message):
    """Reading the scene fails with `message` and the line that holds `where`, the first where it is empty."""
    with pytest.raises(ValueError) as error:
        _C.read_scene(path)
    text = str(error.value)
    assert message in text and text.startswith(path + ":")
    number = int(text.removeprefix(path + ":").split(":")[0])
    assert number == line_of(path, where)
