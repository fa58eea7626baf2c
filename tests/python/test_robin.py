"""Robin sides of operators.Diffusion, -κ ∂u/∂n = h (u - u_ext), against assembled matrices and closed forms."""

import itertools

import numpy as np
import pytest
import torch

import prdp_torch as prdp
from prdp_torch.operators import Diffusion

F64 = torch.float64


def rand(*shape, seed=0):
    return 0.3 + torch.rand(shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


# Sides by axis: names, or the extents of h.
CASES = [
    ((5,), [((2,), "zero")], (1.3,)),
    ((5,), [((), "flux")], (1.0,)),
    ((4, 3), [((1, 3), (2, 3)), ("flux", ())], (2.0, 0.5)),
    ((1, 4), [("periodic",) * 2, ((1, 1), "flux")], (1.0, 2.0)),
    ((2, 2, 3), [("periodic",) * 2, ((2, 2, 3), "zero"), ((1, 2, 2), (1, 2, 2))], (1.0, 3.0, 2.0)),
]
of_cases = pytest.mark.parametrize("shape, sides, lengths", CASES, ids=str)


def tensors_of(sides):
    """h of each Robin side."""
    return [rand(*side, seed=10 + i) for i, side in enumerate(s for pair in sides for s in pair) if side != str(side)]


def boundary_of(sides, robin):
    robin = iter(robin)
    return [tuple(side if isinstance(side, str) else ("robin", next(robin)) for side in pair) for pair in sides]


def assembled(kappa, shift, sides, robin, u_ext, lengths):
    """A and the part of b that u_ext makes, of one sample, cell by cell: half a cell and the side in series."""
    shape, n = kappa.shape, kappa.size
    a, b, index = np.zeros((n, n)), np.zeros(n), np.arange(n).reshape(shape)
    fields = iter(robin)
    h_of = {(axis, end): next(fields) for axis, pair in enumerate(sides) for end, s in enumerate(pair) if s != str(s)}
    for cell in itertools.product(*map(range, shape)):
        i = index[cell]
        a[i, i] += shift[cell]
        for axis, pair in enumerate(sides):
            width = lengths[axis] / shape[axis]
            for end, side in enumerate(pair):
                there = list(cell)
                there[axis] += (-1, 1)[end]
                if 0 <= there[axis] < shape[axis] or side == "periodic":
                    there[axis] %= shape[axis]
                    j = index[tuple(there)]
                    t = 2 / (1 / kappa[cell] + 1 / kappa[tuple(there)]) / width**2
                    a[i, i] += t
                    a[i, j] -= t
                elif side != "flux":
                    of_side = tuple(c for d, c in enumerate(cell) if d != axis)
                    resistance = width / 2 / kappa[cell]
                    if side != "zero":
                        h = np.asarray(h_of[axis, end])
                        resistance += 1 / (h if h.ndim == 0 else h[of_side])
                    a[i, i] += 1 / resistance / width
                    b[i] += u_ext / resistance / width
    return a, b


@of_cases
def test_products_diagonal_matrix_and_values(shape, sides, lengths):
    kappa, shift, robin, v = rand(2, *shape), rand(2, *shape, seed=1), tensors_of(sides), rand(2, 3, *shape, seed=2)
    a = Diffusion(kappa, shift, boundary=boundary_of(sides, robin), length=lengths)
    b = a.boundary_rhs(values=0.7)
    for i in range(2):
        of_sample = [h if h.dim() == 0 else h[i % len(h)] for h in robin]
        dense, expected = assembled(kappa[i].numpy(), shift[i].numpy(), sides, of_sample, 0.7, lengths)
        np.testing.assert_allclose(a.dense()[i], dense, rtol=1e-12, atol=1e-10)
        np.testing.assert_allclose(a.apply(v)[i].flatten(1), v[i].flatten(1).numpy() @ dense.T, rtol=1e-12, atol=1e-10)
        np.testing.assert_allclose(a.diagonal()[i].flatten(), np.diag(dense), rtol=1e-12)
        np.testing.assert_allclose(b[i].flatten(), expected, rtol=1e-12)
    assert prdp.check_operator(a, v)
    for solver in (prdp.CG(200, rtol=1e-13), prdp.Direct(), prdp.CG(40, rtol=1e-13, preconditioner="multigrid")):
        u = prdp.linear_solve(a, v, solver)[0]
        expected = torch.linalg.solve(a.dense(), v.flatten(2).mT).mT.view_as(v)
        torch.testing.assert_close(u, expected, rtol=1e-10, atol=1e-12)


@of_cases
def test_gradients(shape, sides, lengths):
    b, u_ext = rand(2, 2, *shape, seed=3), torch.tensor(0.7, dtype=F64)

    def solve(kappa, u_ext, *robin, solver, backward="implicit"):
        a = Diffusion(kappa, 0.5, boundary=boundary_of(sides, robin), length=lengths)
        return prdp.linear_solve(a, b + a.boundary_rhs(values=u_ext), solver, backward)[0]

    inputs = [t.requires_grad_() for t in (rand(1, *shape), u_ext, *tensors_of(sides))]
    for solver, backward in (
        (prdp.CG(80, rtol=1e-13), "implicit"),
        (prdp.Direct(), "implicit"),
        (prdp.CG(3, rtol=0.0), "unrolled"),
        (prdp.Jacobi(3, rtol=0.0), "unrolled"),
    ):
        assert torch.autograd.gradcheck(lambda *t, s=solver, m=backward: solve(*t, solver=s, backward=m), inputs)
    assert torch.autograd.gradgradcheck(lambda *t: solve(*t, solver=prdp.Direct()), inputs, fast_mode=True)


@pytest.mark.parametrize("h", [0.5, 20.0])
def test_a_heated_bar_against_its_closed_form(h):
    """-κ u″ = 1 with u(0) = 1, and -κ u′ = h (u - 2) at the other end; a parabola, so that only h differs by h²/8κ."""
    kappa, errors = 0.8, []
    for n in (20, 40):
        a = Diffusion(torch.full((1, n), kappa, dtype=F64), boundary=[("zero", ("robin", h))])
        b = 1 + a.boundary_rhs(values=[(1.0, 2.0)])
        u, _ = prdp.linear_solve(a, b, prdp.Direct())
        x = (torch.arange(n, dtype=F64) + 0.5) / n
        slope = (1 + h / (2 * kappa) + h * (2 - 1)) / (kappa + h)  # of -x²/2κ + slope x + 1
        errors.append((u[0, 0] - (1 + slope * x - x**2 / (2 * kappa))).abs().max())
    assert errors[0] < 1e-3 and 3.5 < errors[0] / errors[1] < 4.5


def test_its_limits_are_the_sides_without_flux_and_with_values():
    kappa = rand(1, 6, 5)
    for h, other in ((0.0, "flux"), (1e12, "zero")):
        robin, limit = Diffusion(kappa, boundary=("robin", h)), Diffusion(kappa, boundary=other)
        torch.testing.assert_close(robin.dense(), limit.dense(), rtol=1e-9, atol=1e-9)
        assert (robin.kind == "singular_diffusion") == (limit.kind == "singular_diffusion")
    u, _ = prdp.linear_solve(
        Diffusion(kappa, boundary=("robin", 1.0)), torch.zeros(1, 1, 6, 5, dtype=F64) + 1, prdp.CG(99)
    )
    assert (u > 0).all()


def held(h, rows=1, dtype=F64):
    """h of a side of 5 cells that holds u at the middle three alone."""
    side = torch.tensor([0.0, h, h, h, 0.7], dtype=dtype)
    return side.expand(rows, 5).clone()


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("per_axis", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_an_infinite_h_holds_u(dtype, per_axis, backward):
    """Gradients too: those of a large h, whose own is zero."""
    b, rtol = rand(2, 1, 6, 5).to(dtype), 1e-12 if dtype == F64 else 1e-6

    def gradients(h):
        kappa = rand(2, *((2,) if per_axis else ()), 6, 5).to(dtype).requires_grad_()
        side = held(h, dtype=dtype).requires_grad_()
        a = Diffusion(kappa, boundary=[(("robin", side), "flux"), "flux"], per_axis=per_axis)
        u, info = prdp.linear_solve(a, b + a.boundary_rhs(values=0.7), prdp.CG(60, rtol), backward)
        assert not info.failed.any()
        return u.detach(), *torch.autograd.grad(u.square().sum(), (kappa, side))

    for found, expected in zip(gradients(torch.inf), gradients(1e12), strict=True):
        atol = 1e-6 * float(expected.abs().max())
        torch.testing.assert_close(found, expected, rtol=1e-9 if dtype == F64 else 1e-3, atol=atol)


@pytest.mark.parametrize("solver", [prdp.Direct(), prdp.CG(60, 1e-12, preconditioner="multigrid"), prdp.CG(60, 1e-12)])
def test_a_gradient_beside_an_infinite_h_is_that_of_differences(solver):
    b = rand(2, 1, 6, 5)

    def mean(kappa):
        a = Diffusion(kappa, boundary=[(("robin", held(torch.inf)), "flux"), "flux"])
        return prdp.linear_solve(a, b, solver)[0].mean()

    assert torch.autograd.gradcheck(mean, rand(1, 6, 5).requires_grad_())
    assert torch.autograd.gradgradcheck(mean, rand(1, 6, 5).requires_grad_(), fast_mode=True)
    assert prdp.check_operator(Diffusion(rand(1, 6, 5), boundary=[(("robin", held(torch.inf)), "flux"), "flux"]), b)


def test_what_is_outside_is_inside_where_nothing_else_holds_u():
    """u = u_ext is the solution of b = 0, whatever h."""
    a = Diffusion(rand(1, 6, 5), boundary=[("robin", rand(1, 5)), ("flux", ("robin", 3.0))])
    u, _ = prdp.linear_solve(a, a.boundary_rhs(values=4.0), prdp.CG(200, rtol=1e-13))
    torch.testing.assert_close(u, torch.full_like(u, 4.0))


def test_vmap_over_h_is_a_loop():
    kappa, b, many = rand(2, 4, 3), rand(2, 1, 4, 3), rand(5, 1, 3)

    def solve(h):
        a = Diffusion(kappa, boundary=[(("robin", h), "flux"), "flux"])
        return prdp.linear_solve(a, b, prdp.CG(99, rtol=1e-13))[0]

    torch.testing.assert_close(torch.func.vmap(solve)(many), torch.stack([solve(h) for h in many]))
    of_samples = torch.cat([many, many]).unflatten(0, (5, 2)).squeeze(2)
    torch.testing.assert_close(torch.func.vmap(solve)(of_samples), torch.stack([solve(h) for h in of_samples]))
    kappa, b, low = kappa.float(), b.float(), many.float()  # in float32 h is looked at, as it may be too small
    torch.testing.assert_close(torch.func.vmap(solve)(low), torch.stack([solve(h) for h in low]))
    kappa, b = kappa.double(), b.double()
    gradient = torch.func.grad(lambda h: solve(h).square().sum())(many[0])
    leaf = many[0].clone().requires_grad_()
    torch.testing.assert_close(gradient, torch.autograd.grad(solve(leaf).square().sum(), leaf)[0])


@pytest.mark.parametrize("boundary, words", [
    ("robin", r"boundary must be 'zero', 'flux', 'periodic' or \('robin', h\)"),
    (("robin", "robin"), "boundary must be"),
    ([("robin", "zero"), "flux"], "boundary must be"),
    (("robin", torch.ones(1, 5)), r"h of the low side of axis 1 must be .* where side is \[4\], got \[1, 5\]"),
    ([("robin", torch.ones(5)), "flux"], r"h of the low side of axis 0 must be a number or have shape .*, got \[5\]"),
    (("robin", -1.0), "h of a Robin side must be finite and >= 0, got -1"),
    (("robin", float("inf")), 'must be finite and >= 0, got inf; "zero" holds u at 0 there'),
    ([("robin", torch.full((1, 5), -2.0)), "flux"], "h of a Robin side must be finite and >= 0, got -2"),
])  # fmt: skip
def test_mistakes_are_named(boundary, words):
    with pytest.raises(ValueError, match=words):
        prdp.linear_solve(Diffusion(torch.ones(1, 4, 5), boundary=boundary), torch.ones(1, 1, 4, 5), prdp.CG(3))


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_an_empty_batch_is_no_trouble(dtype):
    h, shift = torch.ones(0, 5, dtype=dtype), torch.ones(0, 4, 5, dtype=dtype)
    a = Diffusion(torch.ones(1, 4, 5, dtype=dtype), shift, boundary=[("robin", h), "flux"])
    u, _ = prdp.linear_solve(a, torch.ones(0, 1, 4, 5, dtype=dtype), prdp.CG(3))
    assert u.shape == (0, 1, 4, 5)


def test_h_of_another_batch_is_named():
    a = Diffusion(torch.ones(1, 4), boundary=[(("robin", torch.ones(3)), "zero")])
    with pytest.raises(ValueError, match="h of a Robin side holds 3 samples, the vector holds 2"):
        prdp.linear_solve(a, torch.ones(2, 1, 4), prdp.CG(3))
    with pytest.raises(ValueError, match=r"values must broadcast to \(batch or 1, \*side\), here \(3,\), got \(2,\)"):
        a.boundary_rhs(values=[(torch.ones(2), 0.0)])
    hole = torch.tensor([1.0, torch.nan, 1.0])
    a = Diffusion(torch.ones(1, 4), boundary=[(("robin", hole), "zero")])
    _, info = prdp.linear_solve(a, torch.ones(3, 1, 4), prdp.CG(9), on_failure="return")
    assert info.failed.tolist() == [False, True, False]


@pytest.mark.parametrize("u_ext", [0.0, 2.0, 20.0, 300.0])
@pytest.mark.parametrize("h", [1e-3, 1.0, 1e3, 1e5, 1e8])
def test_a_gradient_for_h_keeps_its_digits_in_float32(h, u_ext):
    """u(0) = u_ext + 1/h + 1/2, so h² du(0)/dh = -1. The shares of A and of the sides cancel but for that."""
    h = torch.tensor(h, requires_grad=True)
    a = Diffusion(torch.ones(1, 32), boundary=[("flux", ("robin", h))])
    u, _ = prdp.linear_solve(a, 1 + a.boundary_rhs(values=[(None, u_ext)]), prdp.Direct())
    (gradient,) = torch.autograd.grad(u[0, 0, 0], h)
    assert float(gradient * h.detach() ** 2) == pytest.approx(-1.0, abs=1e-4 + 3e-5 * u_ext)


@pytest.mark.parametrize("h", [0.0, 1e-30, 0.7, 1e20])
def test_what_autograd_records_of_a_robin_side_is_its_product_rule(h):
    kappa, h = rand(2, 5).requires_grad_(), torch.tensor(h, dtype=F64, requires_grad=True)
    v, w = rand(2, 1, 5, seed=1), rand(2, 1, 5, seed=2)
    a = Diffusion(kappa, 0.3, boundary=[("flux", ("robin", h))])
    rule = torch.autograd.grad((a.apply(v) * w).sum(), (kappa, h))
    recorded = torch.autograd.grad((a.apply(v) * w).sum(), (kappa, h), create_graph=True)
    tangents = [
        torch.func.jvp(lambda k, h: (Diffusion(k, 0.3, boundary=[("flux", ("robin", h))]).apply(v) * w).sum(), *pair)[1]
        for pair in [((kappa.detach(), h.detach()), (torch.zeros(2, 5, dtype=F64), torch.ones((), dtype=F64)))]
    ]
    for mine, other in zip(rule, recorded, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-12, atol=1e-30)
    torch.testing.assert_close(tangents[0], rule[1], rtol=1e-12, atol=1e-30)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("h", [0.0, 1e-30, 1e-20, 0.7, 8.0, 1e20])
def test_derivatives_of_a_side_in_series_at_any_h(h, dtype):
    """Of a h/(a + h)/w, with a = 2κ/w for κ = 1 in four cells of width w; h = 8 is a tie."""
    a, w = 8.0, 0.25
    h = torch.tensor(h, dtype=dtype, requires_grad=True)
    given = Diffusion(torch.ones(1, 4, dtype=dtype), 1.0, boundary=[("flux", ("robin", h))])
    for c in (
        given.boundary_rhs(values=[(None, 1.0)])[0, 0, -1],
        given.apply(torch.ones(1, 1, 4, dtype=dtype))[0, 0, -1],
    ):
        (first,) = torch.autograd.grad(c, h, create_graph=True)
        (second,) = torch.autograd.grad(first, h)
        size = a / (a + h.item())
        assert float(first.detach()) == pytest.approx(size**2 / w, rel=1e-5, abs=1e-36)
        assert float(second.detach()) == pytest.approx(-2 * size**2 / (a + h.item()) / w, rel=1e-5, abs=1e-36)
