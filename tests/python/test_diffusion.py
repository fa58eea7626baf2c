"""operators.Diffusion: finite volumes in flux form, against an assembled matrix and closed forms."""

import itertools
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch

import prdp_torch as prdp
from benchmarks import volumes
from prdp_torch.operators import Diffusion, Stencil

F64 = torch.float64
SIDES = ["zero", "flux", "periodic"]


def rand(*shape, seed=0, dtype=F64):
    return 0.3 + torch.rand(shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def matrix(kappa, shift, sides, lengths, faces="harmonic"):
    """The matrix on one sample, cell by cell."""
    kappa = np.asarray(kappa)
    shape, n = kappa.shape, kappa.size
    a = np.zeros((n, n))
    index = np.arange(n).reshape(shape)
    for cell in itertools.product(*map(range, shape)):
        i = index[cell]
        a[i, i] += shift if np.isscalar(shift) else shift[cell]
        for axis, (low, high) in enumerate(sides):
            h2 = (lengths[axis] / shape[axis]) ** 2
            for step, side in ((-1, low), (1, high)):
                other = list(cell)
                other[axis] += step
                if not 0 <= other[axis] < shape[axis]:
                    if side != "periodic":
                        a[i, i] += 2 * kappa[cell] / h2 if side == "zero" else 0.0
                        continue
                    other[axis] %= shape[axis]
                x, y = kappa[cell], kappa[tuple(other)]
                t = (2 * x * y / (x + y) if faces == "harmonic" else (x + y) / 2) / h2
                a[i, i] += t
                a[i, index[tuple(other)]] -= t
    return a


CASES = [
    ((5,), [("zero", "flux")], (1.0,)),
    ((4, 3), [("flux", "zero"), ("periodic",) * 2], (2.0, 0.5)),
    ((2, 1), [("periodic",) * 2, ("zero", "zero")], (1.0, 1.0)),
    ((3, 2, 4), [("zero", "zero"), ("flux", "flux"), ("periodic",) * 2], (1.0, 3.0, 2.0)),
    ((1, 3), [("periodic",) * 2, ("zero", "flux")], (1.0, 1.0)),
    ((2, 1, 2), [("periodic",) * 2] * 3, (1.0, 3.0, 2.0)),
]


@pytest.mark.parametrize("faces", ["harmonic", "arithmetic"])
@pytest.mark.parametrize("shape, sides, lengths", CASES, ids=str)
def test_products_diagonal_and_matrix(shape, sides, lengths, faces):
    kappa, shift = rand(2, *shape), rand(2, *shape, seed=1)
    a = Diffusion(kappa, shift, boundary=sides, length=lengths, faces=faces)
    dense = np.stack([matrix(kappa[i], shift[i].numpy(), sides, lengths, faces) for i in range(2)])
    v = rand(2, 3, *shape, seed=2)
    expected = np.einsum("bij,bcj->bci", dense, v.flatten(2).numpy())
    np.testing.assert_allclose(a.apply(v).flatten(2), expected, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(a.apply(v.requires_grad_()).detach().flatten(2), expected, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(a.dense(), dense, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(a.diagonal().flatten(1), np.einsum("bii->bi", dense), rtol=1e-12)
    assert prdp.check_operator(a, v.detach())


@pytest.mark.parametrize("faces", ["harmonic", "arithmetic"])
@pytest.mark.parametrize("shape, sides, lengths", CASES, ids=str)
def test_gradients(shape, sides, lengths, faces):
    b = rand(2, 2, *shape, seed=3)

    def solve(kappa, shift, b, solver, backward="implicit"):
        a = Diffusion(kappa, shift, boundary=sides, length=lengths, faces=faces)
        return prdp.linear_solve(a, b, solver, backward)[0]

    for kappa, shift in ((rand(2, *shape), rand(2, *shape, seed=1)), (rand(1, *shape), torch.tensor(2.0, dtype=F64))):
        inputs = [t.requires_grad_() for t in (kappa, shift, b.clone())]
        for solver in (prdp.CG(80, rtol=1e-13), prdp.Direct(), prdp.CG(40, rtol=1e-13, preconditioner="multigrid")):
            assert torch.autograd.gradcheck(lambda *t, s=solver: solve(*t, s), inputs)
        assert torch.autograd.gradcheck(lambda *t: solve(*t, prdp.CG(3, rtol=0.0), "unrolled"), inputs)


def stencil_of(kappa):
    """`Diffusion` with u = 0 on all sides, as autograd sees it through the coefficients of a `Stencil`."""
    k = kappa[0]
    fields = []
    for axis in (0, 1):
        for step in (-1, 1):
            there = k.roll(-step, axis)
            face = 2 * k * there / (k + there)
            end = -1 if step > 0 else 0
            keep = torch.ones_like(face)
            keep.select(axis, end).zero_()
            fields.append((keep * face + (1 - keep) * 2 * k) * len(k) ** 2)
    coefficients = torch.stack([sum(fields), *(-face for face in fields)])[None]
    return Stencil(coefficients, [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])


def test_in_float32_its_gradient_keeps_digits_that_coefficients_lose():
    n = 128
    y, x = torch.meshgrid(*[(torch.arange(n, dtype=F64) + 0.5) / n] * 2, indexing="ij")
    kappa = torch.exp(torch.sin(6 * x) * torch.cos(5 * y))[None]

    def gradient(make, dtype, rtol):
        k = kappa.to(dtype, copy=True).requires_grad_()
        solver = prdp.CG(50, rtol=rtol, preconditioner="multigrid")
        u, _ = prdp.linear_solve(make(k), torch.ones(1, 1, n, n, dtype=dtype), solver)
        return torch.autograd.grad(u.square().sum(), k)[0].double()

    exact = gradient(Diffusion, F64, 1e-12)
    torch.testing.assert_close(gradient(stencil_of, F64, 1e-12), exact, rtol=1e-6, atol=1e-9 * exact.abs().max().item())
    of_fluxes, of_coefficients = (
        (gradient(make, torch.float32, 1e-6) - exact).norm() / exact.norm() for make in (Diffusion, stencil_of)
    )
    assert of_fluxes < 2e-5 and of_fluxes < of_coefficients / 4


def test_without_a_hold_the_mean_is_free():
    kappa = rand(1, 8, 8).requires_grad_()
    for boundary in ("flux", "periodic", ["flux", "periodic"]):
        a = Diffusion(kappa, boundary=boundary)
        b = rand(2, 1, 8, 8, seed=4)
        _, info = prdp.linear_solve(a, b, prdp.CG(200, rtol=1e-10), on_failure="return")
        assert (info.status == prdp.SolveStatus.INCONSISTENT).all()
        b = b - b.mean((-2, -1), keepdim=True)
        for solver in (prdp.CG(200, rtol=1e-11), prdp.Direct(), prdp.CG(30, rtol=1e-11, preconditioner="multigrid")):
            u, info = prdp.linear_solve(a, b, solver)
            assert info.solved.all() and u.mean((-2, -1)).abs().max() < 1e-14
            (g,) = torch.autograd.grad(u.sum() + u.square().sum(), kappa)
            assert g.isfinite().all() and g.abs().max() < 1e3


def test_values_and_fluxes_at_the_sides():
    """A straight line, and a layered medium whose flux the harmonic mean makes exact."""
    n = 10
    kappa = torch.ones(1, n, 3, dtype=F64)
    kappa[:, n // 2 :] = 100.0
    a = Diffusion(kappa, boundary=["zero", "flux"])
    b = a.boundary_rhs(values=[(1.0, 3.0), (0.0, 0.0)])
    u, _ = prdp.linear_solve(a, b, prdp.Direct())
    flux = 2.0 / (0.5 / 1 + 0.5 / 100)
    x = (torch.arange(n, dtype=F64) + 0.5) / n
    expected = torch.where(x < 0.5, 1 + flux * x, 3 - flux / 100 * (1 - x))
    torch.testing.assert_close(u[0, 0], expected[:, None].expand(n, 3), rtol=1e-10, atol=1e-10)

    a = Diffusion(torch.full((1, n), 2.0, dtype=F64), boundary=[("zero", "flux")], length=4.0)
    inflow = torch.tensor(0.5, dtype=F64, requires_grad=True)
    u, _ = prdp.linear_solve(a, a.boundary_rhs(values=1.0, fluxes=inflow), prdp.Direct())
    torch.testing.assert_close(u[0, 0], 1 + 0.25 * 4 * x, rtol=1e-10, atol=1e-10)
    (slope,) = torch.autograd.grad(u[0, 0, -1], inflow)
    torch.testing.assert_close(slope, 0.5 * 4 * x[-1], rtol=1e-10, atol=1e-10)


def test_values_of_sides_may_differ_in_their_batch():
    """One side has a value for each sample, the next one for all; each as if it were alone."""
    a = Diffusion(rand(1, 4, 3), boundary=["zero", "flux"])
    left, flux = rand(5, 3, seed=1), rand(5, 4, seed=2)
    many = a.boundary_rhs(values=[(left, 2.0), (0.0, 0.0)], fluxes=[(0.0, 0.0), (flux, 0.5)])
    assert many.shape == (5, 1, 4, 3)
    for i in range(5):
        one = a.boundary_rhs(values=[(left[i : i + 1], 2.0), (0.0, 0.0)], fluxes=[(0.0, 0.0), (flux[i : i + 1], 0.5)])
        torch.testing.assert_close(many[i : i + 1], one)
    with pytest.raises(ValueError, match="Diffusion: the high side of axis 0 holds 2 samples, the sides before it 5"):
        a.boundary_rhs(values=[(left, left[:2]), (0.0, 0.0)])


def test_on_meta_it_has_shapes_alone():
    a = Diffusion(torch.ones(1, 4, 3, device="meta"))
    u, _ = prdp.linear_solve(a, torch.ones(2, 1, 4, 3, device="meta"), prdp.CG(3))
    assert u.is_meta and u.shape == (2, 1, 4, 3)


def test_values_and_fluxes_that_no_side_takes_are_refused():
    a = Diffusion(torch.ones(1, 4, 3), boundary="flux")
    with pytest.raises(ValueError, match="Diffusion: values belong to sides that are 'zero' or 'robin'; the boundary"):
        a.boundary_rhs(values=1.0)
    with pytest.raises(ValueError, match="Diffusion: values belong to sides that are 'zero'"):
        Diffusion(torch.ones(1, 4), boundary=[("flux", "zero")]).boundary_rhs(values=[(1.0, 0.0)])
    with pytest.raises(ValueError, match="Diffusion: fluxes belong to sides that are 'flux'"):
        Diffusion(torch.ones(1, 4), boundary="zero").boundary_rhs(fluxes=torch.ones(()))
    assert not a.boundary_rhs(values=0.0).any()


def test_it_is_second_order_and_a_step_of_diffusion():
    errors = []
    for n in (16, 32):
        x = (torch.arange(n, dtype=F64) + 0.5) / n
        b = torch.sin(torch.pi * x)
        u, _ = prdp.linear_solve(
            Diffusion(torch.ones(1, n, dtype=F64), shift=10.0), b.view(1, 1, n), prdp.CG(99, 1e-12)
        )
        errors.append((u[0, 0] - b / (10 + torch.pi**2)).abs().max())
    assert 3.7 < errors[0] / errors[1] < 4.3


def test_arguments_are_checked():
    kappa = rand(1, 4, 4)
    for arguments, message in (
        ({"boundary": "neumann"}, r"boundary must be 'zero', 'flux', 'periodic' or \('robin', h\)"),
        ({"boundary": None}, r"boundary must be 'zero', 'flux', .*got None"),
        ({"boundary": [None]}, r"boundary must be 'zero', 'flux', .*got \[None\]"),
        ({"boundary": [("periodic", "zero"), "zero"]}, "both sides of an axis are periodic or none is"),
        ({"boundary": ["zero"]}, "for each of 2 axes"),
        ({"faces": "upwind"}, "faces must be 'harmonic' or 'arithmetic'"),
        ({"shift": torch.ones(3)}, "shift must be a number or have the shape of kappa"),
        ({"length": 0.0}, "length"),
    ):
        with pytest.raises(ValueError, match=message):
            Diffusion(kappa, **arguments)
    with pytest.raises(ValueError, match=r"Diffusion: kappa must be > 0, got -1"):
        prdp.linear_solve(Diffusion(-torch.ones(1, 4, 4)), torch.ones(1, 1, 4, 4), prdp.CG(3))
    hole = torch.ones(3, 4, 4)
    hole[1, 2, 3] = 0
    with pytest.raises(ValueError, match=r"kappa must be > 0, got 0 in sample 1 at index \[2, 3\]"):
        prdp.linear_solve(Diffusion(hole), torch.ones(3, 1, 4, 4), prdp.CG(3))
    for wrong, b, got in ((kappa, (4, 5), r"\[1, 4, 4\] and b \[1, 1, 4, 5\]"), (kappa[0], (4, 4), r"\[4, 4\] and b")):
        expected = r"Diffusion: expected kappa \(batch or 1, \*shape\) and b \(batch, channel, \*shape\), got kappa "
        with pytest.raises(ValueError, match=expected + got):
            prdp.linear_solve(Diffusion(wrong), torch.ones(1, 1, *b, dtype=F64), prdp.CG(3))
    for axes, remedy in ((1, r"take kappa\[:, 0\]"), (2, "with per_axis=True, kappa has a field for each axis")):
        with pytest.raises(ValueError, match=remedy):
            prdp.linear_solve(Diffusion(torch.ones(3, axes, 4, 4)), torch.ones(3, 1, 4, 4), prdp.CG(3))
    bad = kappa.clone()
    bad[0, 1, 2] = torch.nan
    with pytest.raises(torch.linalg.LinAlgError, match="NONFINITE_OPERATOR"):
        prdp.linear_solve(Diffusion(bad), torch.ones(1, 1, 4, 4, dtype=F64), prdp.CG(3))


@pytest.mark.parametrize("boundary", SIDES)
def test_it_is_the_stencil_with_its_coefficients(boundary):
    kappa = rand(1, 6, 7)
    a = Diffusion(kappa, shift=1.0, boundary=boundary)
    v = rand(1, 2, 6, 7, seed=5)
    dense = matrix(kappa[0], 1.0, [(boundary,) * 2] * 2, (1.0, 1.0))
    index = torch.arange(42).reshape(6, 7)
    offsets = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
    fields = [torch.tensor(dense[index.flatten(), index.roll([-o for o in offset], (0, 1)).flatten()]).reshape(6, 7)
              for offset in offsets]  # fmt: skip
    stencil = Stencil(torch.stack(fields)[None], offsets, "periodic" if boundary == "periodic" else "zero")
    b = rand(1, 2, 6, 7, seed=6)
    for solver in (prdp.CG(99, 1e-12), prdp.Direct(), prdp.Jacobi(9, 0.0)):
        ours, theirs = (prdp.linear_solve(x, b, solver, on_failure="return")[0] for x in (a, stencil))
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(a.apply(v), stencil.apply(v), rtol=1e-12, atol=1e-10)


@pytest.mark.parametrize("shape", [(5,), (4, 4), (3, 3, 3)])
def test_the_benchmarks_hand_the_same_matrix_to_their_rivals(shape):
    kappa = torch.rand(1, *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 0.1
    cells = np.arange(kappa.numel()).reshape(shape)
    held = np.concatenate([np.take(cells, end, axis).ravel() for axis in range(len(shape)) for end in (0, -1)])
    values, places = volumes.entries(kappa.flatten().numpy(), volumes.neighbours(cells), held)
    found = np.zeros((cells.size, cells.size))
    np.add.at(found, places, shape[0] ** 2 * values)
    np.testing.assert_allclose(found, Diffusion(kappa).dense(), rtol=1e-13, atol=1e-12)


def blob(n, jump):
    kappa = torch.ones(1, n, n)
    kappa[:, n // 3 : n // 2, n // 3 : n // 2] = jump
    return kappa


def at_sides(n, h):
    """Robin sides by hand: a shift that is zero inside."""
    shift = torch.zeros(1, n, n)
    for side in (shift[:, 0], shift[:, -1], shift[..., 0], shift[..., -1]):
        side += h * n
    return shift


HELD = [
    (blob(64, 1e3), {"shift": 1.0, "boundary": "flux"}, None),  # products of differences keep it
    (blob(64, 1e3), {"shift": 1.0, "boundary": ("robin", 0.0)}, "act as one of about 1, is lost in the rounding"),
    (blob(64, 1e3).double(), {"shift": 1.0, "boundary": ("robin", 0.0)}, None),
    (blob(128, 1.3), {"shift": at_sides(128, 2e-3), "boundary": "flux"}, None),
    (blob(128, 1.3), {"boundary": ("robin", 2e-3)}, "sides that act as one of about 0.00799"),
    (blob(128, 1.3), {"boundary": ("robin", 1.0)}, None),
    (blob(64, 1e5), {"boundary": "zero"}, "is lost in the rounding"),
    (blob(64, 1e2), {"boundary": "zero", "shift": 1e-4}, None),
    (blob(64, 1e5), {"boundary": "flux"}, None),  # nothing holds u, and A knows
]


@pytest.mark.filterwarnings("ignore:.* STAGNATED far above rtol")  # u may be wrong then, but is not here
@pytest.mark.parametrize("kappa, given, words", HELD)
def test_it_warns_of_a_hold_that_float32_loses(kappa, given, words):
    """And where it does not, u is right: against float64."""
    torch.set_warn_always(True)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            a = Diffusion(kappa, **given)
    finally:
        torch.set_warn_always(False)
    assert [words in str(w.message) for w in told] == ([True] if words else [])
    if words or a.kind == "singular_diffusion":
        return
    exact = Diffusion(kappa.double(), **{k: v.double() if torch.is_tensor(v) else v for k, v in given.items()})
    b = torch.ones(1, 1, *kappa.shape[1:])
    solver = prdp.CG(300, rtol=1e-6, preconditioner="multigrid")
    u = prdp.linear_solve(a, b.to(kappa.dtype), solver)[0]
    expected = prdp.linear_solve(exact, b.double(), prdp.Direct())[0]
    assert (u - expected).norm() < 2e-3 * expected.norm()


def test_what_float32_cannot_hold_is_not_called_singular():
    """A is definite; there is no nullspace= that could be given."""
    a = Diffusion(blob(128, 1.3), at_sides(128, 2e-3), boundary="flux")
    with pytest.raises(torch.linalg.LinAlgError, match="A is singular to float32; take float64"):
        prdp.linear_solve(a, torch.ones(1, 1, 128, 128), prdp.Direct())


WARNS_ONCE = """
import torch, prdp_torch as prdp
kappa = torch.ones(1, 64, 64)
kappa[:, 20:40, 20:40] = 1e3
for _ in range(2):
    a = prdp.operators.Diffusion(kappa, shift=1.0, boundary=("robin", 0.0))
    prdp.linear_solve(a, torch.ones(1, 1, 64, 64), prdp.CG(2, rtol=0.0), on_failure="return")
"""


def test_it_warns_once():
    done = subprocess.run([sys.executable, "-c", WARNS_ONCE], capture_output=True, text=True, check=True)
    assert done.stderr.count("act as one of about 1, is lost in the rounding") == 1


@pytest.mark.filterwarnings("ignore:`torch.jit.script")  # by torch's own forward mode
@pytest.mark.parametrize("of", ["kappa", "shift"])
def test_transforms_of_torch_func(of):
    """Against autograd, and vmap against a loop."""
    generator = torch.Generator().manual_seed(2)
    kappa = torch.rand(2, 6, 5, dtype=torch.float64, generator=generator) + 0.5
    shift = torch.rand(2, 6, 5, dtype=torch.float64, generator=generator)
    b = torch.randn(2, 1, 6, 5, dtype=torch.float64, generator=generator)
    x, given = (kappa, {"shift": shift}) if of == "kappa" else (shift, {"kappa": kappa})

    def loss(x):
        return prdp.linear_solve(Diffusion(**{of: x}, **given), b, prdp.CG(100, rtol=1e-13))[0].square().sum()

    leaf = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad(loss(leaf), leaf)
    direction = torch.ones_like(x)
    close = {"rtol": 1e-9, "atol": 1e-11}
    torch.testing.assert_close(torch.func.grad(loss)(x), expected, **close)
    torch.testing.assert_close(torch.func.jvp(loss, (x,), (direction,))[1], expected.sum(), **close)
    many = torch.stack([x, 2 * x])
    torch.testing.assert_close(torch.func.vmap(loss)(many), torch.stack([loss(x), loss(2 * x)]), **close)
    gradients = torch.func.vmap(torch.func.grad(loss))(many)
    torch.testing.assert_close(gradients[0], expected, **close)


def test_a_kappa_that_is_not_positive_is_refused_within_a_transform_as_well():
    b, kappa = torch.ones(2, 1, 4), torch.tensor([[1.0, 1, 1, 1], [1, -1, 1, 1]])
    with pytest.raises(ValueError, match=r"Diffusion: kappa must be > 0, got -1 in sample 1 at index \[1\]"):
        torch.func.grad(lambda k: prdp.linear_solve(Diffusion(k), b, prdp.CG(20))[0].sum())(kappa)


@pytest.mark.parametrize("values, words", [
    ((1.0, 2.0), r"values must be one for all sides or a pair \(low, high\) for each of 2 axes, got \(1.0, 2.0\)"),
    (torch.ones(1, 7), r"values must broadcast to \(batch or 1, \*side\), here \(1, 5\), got \(1, 7\)"),
    (torch.ones(7), r"values must broadcast to \(batch or 1, \*side\), here \(1, 5\), got \(7,\)"),
])  # fmt: skip
def test_values_that_do_not_fit_the_sides_are_named(values, words):
    with pytest.raises(ValueError, match=words):
        Diffusion(torch.ones(1, 4, 5)).boundary_rhs(values=values)
