"""Gradients of fields in one launch on a GPU, over the fibers, beside those of the CPU."""

import pytest
import torch
from fibers import BACKWARD, SHUFFLED, Fibers
from test_gpu_flow import FREE
from test_gpu_kernels import OFFSETS, SHAPE, coefficients, noise, sparse

import prdp_torch as prdp
from prdp_torch import operators

F32, F64 = torch.float32, torch.float64


def stencil(rows):
    scale = 1.0 / coefficients(F64, rows).flatten(1).abs().amax(1)
    field = coefficients(F64, rows) * scale[:, None, None, None]
    return lambda c: operators.Stencil(c, OFFSETS, ("zero", "periodic")), [field], 2


def diffusion(rows, **settings):
    fields = [noise(rows, *SHAPE, seed=2).exp()]
    return lambda kappa, *shift: operators.Diffusion(kappa, *(shift or (50.0,)), **settings), fields, 1


def with_shift(make, fields, channels):
    return lambda kappa, shift: make(kappa, shift), [*fields, 20 + noise(1, *SHAPE)], channels


def per_axis(rows, *shape, **settings):
    fields = [noise(rows, len(shape), *shape, seed=2).exp(), 20 + noise(rows, *shape)]
    return lambda kappa, shift: operators.Diffusion(kappa, shift, per_axis=True, **settings), fields, 2


def robin(rows, sides, axes=(), shape=SHAPE):
    """Of κ, which may have axes, a shift, and h of four sides: a number, or a field of all or of each, which holds u at
    one cell."""

    def make(kappa, shift, *h):
        low, high, left, right = (("robin", of) for of in h)
        sides = ((low, high), (left, right))
        return operators.Diffusion(kappa, shift, boundary=sides, length=(1.0, 2.0), per_axis=bool(axes))

    h = [noise(*sides[k], seed=5 + k).exp() if sides[k] else torch.tensor(1.3, dtype=F64) for k in range(4)]
    for field in h:
        if field.dim() > 0:
            field[:, 1] = torch.inf
    return make, [noise(rows, *axes, *shape, seed=2).exp(), torch.tensor(9.0, dtype=F64), *h], 2


def csr(matrices):
    made = sparse(matrices, F64).to_sparse_csr() if matrices > 1 else sparse(1, F64)[0].to_sparse_csr()
    crow, col = made.crow_indices(), made.col_indices()
    size = (3, 9, 9) if matrices > 1 else 9
    return lambda values: operators.Matrix.csr(crow, col, values, size), [made.values().clone()], None


NU = torch.tensor(0.05, dtype=F64)
LONG = noise(3, 700, seed=2).exp()  # sums that are left in parts
CASES = {
    "stencils": stencil(3),
    "a stencil of all": stencil(1),
    "diffusion": diffusion(3, boundary=("flux", "periodic")),
    "diffusion of all": diffusion(1, boundary=("zero", ("flux", "zero")), faces="arithmetic", length=(1.0, 2.0)),
    "burgers": (lambda w, nu: operators.Burgers(w, nu, 0.02), [noise(1, 2, *SHAPE), NU], 2),
    "burgers 1D": (lambda w, nu: operators.Burgers(w, nu, 0.02), [noise(3, 1, 11), NU], 1),
    "navier-stokes": (lambda w, nu: operators.NavierStokes(w, nu, 0.02), [noise(3, 2, *SHAPE), NU], 3),
    "navier-stokes of all": (lambda w, nu: operators.NavierStokes(w, nu, 0.02), [noise(1, 3, *SHAPE), NU], 3),
    "shift": with_shift(*diffusion(3, boundary=("zero", "periodic"))),
    "diffusion, shift of each": (operators.Diffusion, [LONG[:, :9], 20 + noise(3, 9)], 2),
    "diffusion, shift of all": (operators.Diffusion, [LONG[:1, :9], 20 + noise(3, 9)], 2),
    "diffusion, a number": (operators.Diffusion, [LONG, torch.tensor(1e6, dtype=F64)], 1),
    "diffusion, h of each": robin(3, [(3, SHAPE[1]), (1, SHAPE[1]), (), (3, SHAPE[0])]),
    "diffusion of all, h of each": robin(1, [(3, SHAPE[1]), (), (1, SHAPE[0]), (3, SHAPE[0])]),
    "diffusion per axis 1D": per_axis(3, 11, boundary="zero"),
    "diffusion per axis": per_axis(3, *SHAPE, boundary=("flux", "periodic"), length=(1.0, 2.0)),
    "diffusion of all per axis": per_axis(1, *SHAPE, boundary=("zero", "flux"), faces="arithmetic"),
    "diffusion per axis 3D": per_axis(3, 3, 4, 5, boundary=("periodic", ("zero", "flux"), "zero")),
    "diffusion per axis, h of each": robin(3, [(3, SHAPE[1]), (1, SHAPE[1]), (), (3, SHAPE[0])], axes=(2,)),
    "heat": (lambda nu: operators.Heat(SHAPE, nu, 1.0), [NU], 1),
    "long heat": (lambda nu: operators.Heat((700,), nu, 1e-4), [NU], 1),
    "poisson-like heat 3D": (lambda nu: operators.Heat((3, 4, 5), nu, 1.0, length=(1.0, 2.0, 0.5)), [NU], 1),
    "sparse": csr(1),
    "sparse matrices": csr(3),
}


def solver_of(name, dtype):
    rtol = 1e-12 if dtype == F64 else 1e-6
    if name.startswith("navier"):
        return prdp.GMRES(40, rtol, restart=40)
    symmetric = "diffusion" in name or "heat" in name or name == "shift"
    return prdp.CG(400, rtol) if symmetric else prdp.BiCGStab(100, rtol)


def gradients(name, dtype=F64, **device):
    """And the launches of the backward pass."""
    make, fields, channels = CASES[name]
    leaves = [t.to(dtype, copy=True).requires_grad_() for t in fields]
    shape = make(*leaves).shape if channels else (9,)
    b = noise(3, *([channels] if channels else []), *shape, seed=3, dtype=dtype)
    if channels == 3:
        b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)

    def run():
        u, _ = prdp.linear_solve(make(*leaves), b, solver_of(name, dtype))
        cotangent = 2.0 * u.detach()
        cotangent[:, 2:] *= 0.0 if channels == 3 else 1.0
        torch.autograd.grad(u, leaves, cotangent, retain_graph=True)  # the first result of a kernel is compared
        before = Fibers().launches()
        with torch.autograd.profiler.profile() as profiler:
            found = torch.autograd.grad(u, leaves, cotangent)
        names = [event.name for event in profiler.function_events if event.name.startswith("aten::")]
        return found, Fibers().launches() - before, [n for n in names if n not in FREE]

    if not device:
        return run()
    with Fibers(**device, poison=False):  # which would be operations of its own
        return run()


@pytest.mark.parametrize("name", CASES)
def test_they_are_those_of_the_cpu_in_one_launch(name):
    (expected, *_), (found, launches, of_torch) = gradients(name), gradients(name, threads=32)
    # The sign of each, a sum of parts; the transpose of a sparse matrix is sorted.
    assert len(of_torch) <= (26 if "sparse" in name else 3 + len(found)), of_torch
    assert launches == (3 if "burgers" in name or "navier" in name else 2)  # the adjoint solve; winds and ν
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-9)


IN_ORDER = [
    "a stencil of all",
    "diffusion of all",
    "diffusion of all per axis",
    "burgers",
    "diffusion of all, h of each",
    "long heat",
    "sparse",
]


@pytest.mark.parametrize("name", IN_ORDER)
def test_sums_over_the_batch_have_one_order(name):
    wanted, *_ = gradients(name, F32, threads=32)
    for order in (BACKWARD, SHUFFLED):
        found, *_ = gradients(name, F32, threads=32, order=order)
        assert all(torch.equal(mine, other) for mine, other in zip(found, wanted, strict=True))
