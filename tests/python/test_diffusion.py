"""operators.Diffusion: finite volumes in flux form, against an assembled matrix and closed forms."""

import itertools

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


def test_on_meta_it_has_shapes_alone():
    a = Diffusion(torch.ones(1, 4, 3, device="meta"))
    u, _ = prdp.linear_solve(a, torch.ones(2, 1, 4, 3, device="meta"), prdp.CG(3))
    assert u.is_meta and u.shape == (2, 1, 4, 3)


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


def test_a_shift_for_each_sample():
    kappa, b = rand(2, 4, 5), rand(2, 1, 4, 5)
    shift = torch.tensor([1.0, 50.0], dtype=F64)[:, None, None].requires_grad_()
    u, _ = prdp.linear_solve(Diffusion(kappa, shift), b, prdp.Direct())
    (found,) = torch.autograd.grad(u.square().sum(), shift)
    for i in range(2):
        alone = shift[i, 0, 0].detach().requires_grad_()
        u_alone, _ = prdp.linear_solve(Diffusion(kappa[i : i + 1], alone), b[i : i + 1], prdp.Direct())
        (expected,) = torch.autograd.grad(u_alone.square().sum(), alone)
        torch.testing.assert_close(u[i], u_alone[0])
        torch.testing.assert_close(found[i, 0, 0], expected)


def test_arguments_are_checked():
    kappa = rand(1, 4, 4)
    for arguments, message in (
        ({"boundary": "neumann"}, r"boundary must be 'zero', 'flux', 'periodic' or \('robin', h\)"),
        ({"boundary": None}, r"boundary must be 'zero', 'flux', .*got None"),
        ({"boundary": [None]}, r"boundary must be 'zero', 'flux', .*got \[None\]"),
        ({"boundary": [("periodic", "zero"), "zero"]}, "both sides of an axis are periodic or none is"),
        ({"boundary": ["zero"]}, "for each of 2 axes"),
        ({"faces": "upwind"}, "faces must be 'harmonic' or 'arithmetic'"),
        ({"shift": torch.ones(3)}, "shift must be a number, one for each sample"),
        ({"length": 0.0}, "length"),
    ):
        with pytest.raises(ValueError, match=message):
            Diffusion(kappa, **arguments)
    with pytest.raises(ValueError, match=r"Diffusion: kappa must be > 0, got -1"):
        prdp.linear_solve(Diffusion(-torch.ones(1, 4, 4)), torch.ones(1, 1, 4, 4), prdp.CG(3))
    hole = torch.ones(3, 4, 4)
    hole[1, 2, 3] = 0
    with pytest.raises(ValueError, match=r"kappa must be > 0, got 0 in sample 1 at index \(2, 3\)"):
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
    with pytest.raises(ValueError, match=r"Diffusion: kappa must be > 0, got -1 in sample 1 at index \(1,\)"):
        torch.func.grad(lambda k: prdp.linear_solve(Diffusion(k), b, prdp.CG(20))[0].sum())(kappa)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("jump", [1e4, 1e10, 1e12, 1e16, 1e18, 1e20, 1e25])
def test_direct_fails_where_the_rounding_of_its_factors_moves_u(jump, dtype):
    """A stiff inclusion is one unknown, in the limit."""
    n, inside = 8, torch.zeros(8, 8, dtype=torch.bool)
    inside[2:5, 2:5] = True
    whole = prdp.operators.Diffusion(torch.ones(1, n, n, dtype=torch.float64)).dense()
    interface = inside.flatten()[:, None] != inside.flatten()[None]
    twice = torch.where(interface, 2 * whole, whole).fill_diagonal_(0.0)  # the mean of 1 and a large number is 2
    system = twice + torch.diag(whole.sum(1) - twice.sum(1))  # what the sides hold, and the links
    joined = torch.cat([torch.eye(n * n, dtype=torch.float64)[:, ~inside.flatten()], inside.flatten()[:, None]], 1)
    expected = joined @ torch.linalg.solve(joined.T @ system @ joined, joined.sum(0))

    kappa = torch.where(inside, jump, 1.0).to(dtype)[None]
    u, info = prdp.linear_solve(
        prdp.operators.Diffusion(kappa), torch.ones(1, 1, n, n, dtype=dtype), prdp.Direct(), on_failure="return"
    )
    error = (u.flatten().double() - expected).norm() / expected.norm()
    assert info.failed.all() or error < 2 / jump + 2e-3
    assert jump > 1e12 or not info.failed.any()


@pytest.mark.parametrize("h, n", [(1e-10, 40), (1e-8, 1000)])
def test_direct_keeps_a_weak_side_in_float32(h, n):
    """Its residual is all rounding, and no doubt about its factors."""
    a = prdp.operators.Diffusion(torch.ones(1, n), boundary=[("flux", ("robin", h))])
    u, info = prdp.linear_solve(a, torch.ones(1, 1, n), prdp.Direct())
    assert info.solved.all() and abs(u.mean().item() * h - 1) < 1e-4
