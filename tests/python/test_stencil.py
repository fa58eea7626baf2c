"""Stencils given by their coefficients: products and solves against dense matrices, batches, and mistakes."""

import itertools

import numpy as np
import pytest
import torch
from helpers import field, statuses
from stencils import FAR_2D, NEAREST, NINE, cases, dense, few, random_coefficients

import prdp_torch as prdp
from prdp_torch import _C, operators
from prdp_torch.solvers import packed_options


def symmetric_coefficients(shape, seed=3, batch=2):
    """1 - ∇·(κ∇) with zero boundaries: faces of random κ > 0, in the order of NEAREST."""
    rows, centre = [], torch.ones(batch, *shape, dtype=torch.float64)
    for d in reversed(range(len(shape))):
        faces = list(shape)
        faces[d] += 1
        kappa = field(faces, batch, seed=seed + d)[:, 0].exp()
        lower, upper = kappa.narrow(d + 1, 0, shape[d]), kappa.narrow(d + 1, 1, shape[d])
        rows += [-lower, -upper]
        centre = centre + lower + upper
    return torch.stack([centre, *rows], 1)


@cases
@pytest.mark.parametrize("batch, channels", [(1, 2), (3, 1)])
def test_products_equal_those_of_the_matrix(shape, offsets, boundary, batch, channels):
    c = random_coefficients(shape, offsets, batch, dominant=False)
    a, v = operators.Stencil(c, offsets, boundary), field(shape, 3, channels=channels)
    m = np.broadcast_to(dense(c, offsets, boundary), (3, *[np.prod(shape)] * 2))
    flat = v.flatten(2).numpy()
    close = {"rtol": 1e-12, "atol": 1e-12}
    np.testing.assert_allclose(a.apply(v).flatten(2), np.einsum("bij,bcj->bci", m, flat), **close)
    np.testing.assert_allclose(a.apply_transpose(v).flatten(2), np.einsum("bji,bcj->bci", m, flat), **close)
    np.testing.assert_allclose(a.dense(), m if batch == 3 else m[0], **close)
    np.testing.assert_allclose(a.diagonal().flatten(1), np.einsum("bii->bi", m[:batch]), **close)


def loops_and_tensors(c, offsets, boundary, b, solver, transposed):
    """The solution by the CPU loops, of A or by way of the adjoint solve of Aᵀ, and that by plain tensors."""
    a = operators.Stencil(c, offsets, boundary)
    spec = (a.tensors, a.kind, a.shape, a.parameters, transposed)
    limits = (solver.method, solver.max_iter, solver.rtol, solver.restart)
    loops = torch.ops.prdp.linear_solve(b, *spec, None, *packed_options(*limits, None, "none", on_failure="return"))
    u, info = _C.solve_with_tensors(b, *spec, *limits)
    return loops, (u, *info)


@cases
@pytest.mark.parametrize("transposed", [False, True])
def test_loops_equal_plain_tensors_iteration_by_iteration(shape, offsets, boundary, transposed):
    b = field(shape, 2, seed=5, channels=2)
    for batch in (1, 2):
        c = random_coefficients(shape, offsets, batch)
        for solver in (prdp.Jacobi(4, rtol=0.0), prdp.SteepestDescent(2, rtol=0.0), prdp.GMRES(2, rtol=0.0, restart=3)):
            loops, tensors = loops_and_tensors(c, offsets, boundary, b, solver, transposed)
            torch.testing.assert_close(loops[0], tensors[0], rtol=1e-10, atol=1e-12)
            if solver.method != "gmres":  # whose plain-tensor cycles go on where a Krylov space is exhausted
                assert torch.equal(loops[4], tensors[4])


@cases
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_direct_equals_lapack(shape, offsets, boundary, dtype):
    b = field(shape, 2, seed=5, channels=2, dtype=dtype)
    for batch in (1, 2):
        c = random_coefficients(shape, offsets, batch, dtype=dtype)
        m = np.broadcast_to(dense(c, offsets, boundary), (2, *[np.prod(shape)] * 2))
        a = operators.Stencil(c, offsets, boundary)
        u, _ = prdp.linear_solve(a, b, prdp.Direct())
        expected = np.linalg.solve(m[:, None], b.flatten(2).double().numpy()[..., None])[..., 0]
        close = {"rtol": 1e-4, "atol": 1e-5} if dtype == torch.float32 else {"rtol": 1e-11, "atol": 1e-11}
        np.testing.assert_allclose(u.flatten(2), expected, **close)


@few
@pytest.mark.parametrize("batch", [1, 3])
def test_every_solver_converges_to_the_dense_solution(shape, offsets, boundary, batch):
    c, b = random_coefficients(shape, offsets, batch), field(shape, 3, seed=5, channels=2)
    m = np.broadcast_to(dense(c, offsets, boundary), (3, *[np.prod(shape)] * 2))
    expected = np.linalg.solve(m[:, None], b.flatten(2).numpy()[..., None])[..., 0]
    for solver in (prdp.Jacobi(500, rtol=1e-12), prdp.GMRES(60, rtol=1e-12, restart=12), prdp.Direct()):
        u, info = prdp.linear_solve(operators.Stencil(c, offsets, boundary), b, solver)
        assert (info.status > 0).all(), solver
        np.testing.assert_allclose(u.flatten(2), expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("shape", [(13,), (7, 18), (3, 5, 4)])
def test_symmetric_solvers_converge(shape):
    c, b = symmetric_coefficients(shape), field(shape, 2, seed=5, channels=3)
    a = operators.Stencil(c, NEAREST[len(shape)])
    torch.testing.assert_close(a.dense(), a.dense().mT)
    expected = torch.linalg.solve(a.dense()[:, None], b.flatten(2)[..., None])[..., 0]
    for solver in (prdp.CG(300, rtol=1e-12), prdp.SteepestDescent(3000, rtol=1e-12)):
        u, info = prdp.linear_solve(a, b, solver)
        assert (info.status > 0).all(), solver
        torch.testing.assert_close(u.flatten(2), expected, rtol=1e-9, atol=1e-10)


def test_fake_tensors_know_the_shapes():
    with torch._subclasses.FakeTensorMode():
        a = operators.Stencil(torch.empty(7, 5, 4, 5), NEAREST[2])
        u, info = prdp.linear_solve(a, torch.empty(7, 3, 4, 5), prdp.CG(3))
        assert u.shape == (7, 3, 4, 5) and info.status.shape == (7,)
        assert a.apply(u).shape == u.shape


BATCH_SOLVERS = [prdp.Jacobi(9), prdp.SteepestDescent(9), prdp.CG(9), prdp.GMRES(3), prdp.Direct()]


@pytest.mark.parametrize("solver", BATCH_SOLVERS, ids=lambda s: s.method)
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("offsets", [NEAREST[2], FAR_2D], ids=["nearest", "far"])
def test_samples_do_not_depend_on_the_batch(solver, backward, offsets):
    shape = (6, 17)
    c, b, g = random_coefficients(shape, offsets, 5), field(shape, 5, channels=2), field(shape, 5, 1, channels=2)
    c[3, 1, 2, 2] = torch.nan
    b[1, 0, 3, 4] = torch.inf

    def both(rows):
        coefficients, rhs = c[rows].requires_grad_(), b[rows].requires_grad_()
        a = operators.Stencil(coefficients, offsets, "periodic")
        u, info = prdp.linear_solve(a, rhs, solver, backward=backward, on_failure="return")
        return u.detach(), info, *torch.autograd.grad(u, (coefficients, rhs), g[rows])

    u, info, *gradients = both([0, 1, 2, 3, 4])
    assert statuses(info)[1::2] == ["NONFINITE_INPUT", "NONFINITE_OPERATOR"]
    assert all(t.isfinite().all() for t in (u, *gradients))
    for rows in ([0], [4, 2], [2, 3, 0]):
        part, its_info, *its_gradients = both(rows)
        assert torch.equal(part, u[rows]) and torch.equal(its_info.status, info.status[rows])
        assert all(torch.equal(x, y[rows]) for x, y in zip(its_gradients, gradients, strict=True))


def test_powers_of_two_pass_through():
    c, b = random_coefficients((5, 9), NEAREST[2]), field((5, 9))
    a = operators.Stencil(c, NEAREST[2])
    for solver in (prdp.Jacobi(5), prdp.CG(5), prdp.GMRES(5)):
        u, info = prdp.linear_solve(a, b, solver)
        for s in (2.0**300, 2.0**-300):
            scaled, other = prdp.linear_solve(a, s * b, solver)
            assert torch.equal(scaled, s * u) and torch.equal(other.iterations, info.iterations)


@pytest.mark.parametrize("batch", [1, 2])
def test_a_coefficient_that_is_not_finite_is_named(batch):
    for offsets, bad in itertools.product((NEAREST[2], NINE), (torch.nan, torch.inf)):
        c = random_coefficients((4, 5), offsets, batch)
        c[batch - 1, 3, 2, 4] = bad
        a, b = operators.Stencil(c, offsets), field((4, 5))
        with pytest.raises(torch.linalg.LinAlgError, match=r"NONFINITE_OPERATOR at index \(3, 2, 4\)"):
            prdp.linear_solve(a, b, prdp.CG(3))
        for solve in (
            prdp.linear_solve(a, b, prdp.CG(3), on_failure="return")[1].status,
            _C.solve_with_tensors(b, a.tensors, a.kind, a.shape, a.parameters, False, "cg", 3, 1e-5)[1][2],
        ):
            assert solve[1] == prdp.SolveStatus.NONFINITE_OPERATOR and (batch == 1 or solve[0] != solve[1])


def test_a_zero_on_the_diagonal_is_named():
    for offsets in (NEAREST[2], NINE):
        c = random_coefficients((4, 5), offsets)
        c[1, offsets.index((0, 0)), 2, 3] = 0
        with pytest.raises(torch.linalg.LinAlgError, match=r"sample 1 ZERO_DIAGONAL in row \(0, 2, 3\)"):
            prdp.linear_solve(operators.Stencil(c, offsets), field((4, 5)), prdp.Jacobi(3))


def test_a_stencil_without_the_point_itself():
    """A cyclic shift: no diagonal for Jacobi, exact for GMRES and Direct; on one point it is the diagonal."""
    c, b = torch.full((1, 1, 8), 2.0, dtype=torch.float64), field((8,))
    a = operators.Stencil(c, [(1,)], "periodic")
    with pytest.raises(torch.linalg.LinAlgError, match=r"ZERO_DIAGONAL in row \(0, 0\)"):
        prdp.linear_solve(a, b, prdp.Jacobi(3))
    for solver in (prdp.GMRES(1, restart=8), prdp.Direct()):
        torch.testing.assert_close(prdp.linear_solve(a, b, solver)[0], b.roll(1, -1) / 2)
    one = operators.Stencil(c[..., :1], [(1,)], "periodic")
    torch.testing.assert_close(prdp.linear_solve(one, b[..., :1], prdp.Jacobi(3))[0], b[..., :1] / 2)


def test_direct_pivots_where_it_must():
    """[[0, 1], [1, 0]] and a line without dominance, which elimination without pivoting would spoil."""
    c = torch.tensor([[[0.0, 0.0], [9.0, 1.0], [1.0, 9.0]]], dtype=torch.float64)
    u, _ = prdp.linear_solve(operators.Stencil(c, NEAREST[1]), torch.tensor([[[3.0, 5.0]]]).double(), prdp.Direct())
    torch.testing.assert_close(u, torch.tensor([[[5.0, 3.0]]]).double())
    c = random_coefficients((40,), NEAREST[1], dominant=False)
    c[:, 0] *= 1e-14
    a, b = operators.Stencil(c, NEAREST[1]), field((40,))
    u, _ = prdp.linear_solve(a, b, prdp.Direct())
    torch.testing.assert_close(u[:, 0], torch.linalg.solve(a.dense(), b[:, 0]), rtol=1e-8, atol=1e-8)


def test_a_singular_stencil_breaks_down_in_direct():
    c = torch.tensor([2.0, -1.0, -1.0], dtype=torch.float64)[None, :, None].expand(1, 3, 4)
    info = prdp.linear_solve(operators.Stencil(0 * c, NEAREST[1]), field((4,)), prdp.Direct(), on_failure="return")[1]
    assert statuses(info) == ["BREAKDOWN", "BREAKDOWN"]


def test_any_strides_and_both_precisions():
    c, b = random_coefficients((7, 6), NEAREST[2]).transpose(2, 3), field((7, 6), channels=3).transpose(2, 3)
    expected = prdp.linear_solve(operators.Stencil(c.contiguous(), NEAREST[2]), b.contiguous(), prdp.CG(7))[0]
    assert torch.equal(prdp.linear_solve(operators.Stencil(c, NEAREST[2]), b, prdp.CG(7))[0], expected)
    single = prdp.linear_solve(operators.Stencil(c.float(), NEAREST[2]), b.float(), prdp.CG(7))[0]
    torch.testing.assert_close(single, expected.float(), rtol=1e-4, atol=1e-5)


def test_the_channels_are_one_system():
    """One residual, one set of inner products for all of them."""
    c, b = symmetric_coefficients((6, 5)), field((6, 5), channels=3)
    a = operators.Stencil(c, NEAREST[2])
    u, info = prdp.linear_solve(a, b, prdp.CG(4, rtol=0.0))
    residual = (b - a.apply(u)).flatten(1).norm(dim=1) / b.flatten(1).norm(dim=1)
    torch.testing.assert_close(info.residual, residual)
    block = torch.block_diag(*[a.dense()[1]] * 3)
    expected = prdp.linear_solve(block, b[1].flatten(), prdp.CG(4, rtol=0.0))[0]
    torch.testing.assert_close(u[1].flatten(), expected)


C = torch.ones(2, 5, 4, 6)


@pytest.mark.parametrize("make, error, message", [
    (lambda: operators.Stencil([1.0], NEAREST[2]), TypeError, "Stencil: coefficients must be a torch tensor"),
    (lambda: operators.Stencil(torch.ones(5, 4), NEAREST[2]), ValueError, r"\(batch or 1, k, \*shape\).*got \(5, 4\)"),
    (lambda: operators.Stencil(C.int(), NEAREST[2]), TypeError, "coefficients must be float32 or float64, got int32"),
    (lambda: operators.Stencil(C, NEAREST[2][:4]), ValueError, "4 offsets need coefficients of shape .batch or 1, 4"),
    (lambda: operators.Stencil(C, NEAREST[1]), ValueError, r"every offset must have 2 entries.*got \(0,\)"),
    (lambda: operators.Stencil(C[0], NEAREST[2]), ValueError, r"1 entry.* \(0, 0\); .*so shape is \(\d+,\)"),
    (lambda: operators.Stencil(C, NEAREST[3]), ValueError, r"every offset must have 2 entries.*got \(0, 0, 0\)"),
    (lambda: operators.Stencil(C[:, :1], [(0, 3)]), ValueError, r"reach at most 2 cells along each axis, got \(0, 3\)"),
    (lambda: operators.Stencil(C[:, :2], [(0, 1)] * 2), ValueError, r"the offset \(0, 1\) is there twice"),
    (lambda: operators.Stencil(C[:, :1], [(0, 0.5)]), TypeError, "entry of an offset must be a whole number, got 0.5"),
    (lambda: operators.Stencil(C, 5), TypeError, "offsets must be a list of tuples"),
    (lambda: operators.Stencil(C[:, :0], []), ValueError, "at least one offset"),
    (lambda: operators.Stencil(C[..., :0], NEAREST[2]), ValueError, "every extent >= 1"),
    (lambda: operators.Stencil(C, NEAREST[2], None), ValueError, "boundary must be 'zero' or 'periodic'.*got None"),
    (lambda: operators.Stencil(C, NEAREST[2], "wrap"), ValueError, "boundary must be 'zero' or 'periodic'.*got 'wrap'"),
    (lambda: operators.Stencil(C, NEAREST[2], ["zero"]), ValueError, "one for all axes or one for each of 2"),
    (lambda: solve(C, field((4, 7))), ValueError, r"Stencil: expected \(batch, channel, 4, 6\), got \[2, 1, 4, 7\]"),
    (lambda: solve(C, field((4, 6), 3)), ValueError, "the coefficients hold 2 samples, the vector holds 3"),
    (lambda: solve(C, field((4, 6))), TypeError, "the coefficients are float32 but the vector is float64"),
    (lambda: solve(C, torch.ones(2, 1, 4, 6, device="meta")), ValueError, "are on cpu but the vector is on meta"),
])  # fmt: skip
def test_mistakes_are_named(make, error, message):
    with pytest.raises(error, match=message):
        make()


def solve(c, b):
    return prdp.linear_solve(operators.Stencil(c, NEAREST[2]), b, prdp.CG(3))


def test_repr():
    assert repr(operators.Stencil(C, NEAREST[2], "periodic")) == (
        "Stencil(shape=(4, 6), coefficients=tensor(2, 5, 4, 6), "
        "offsets=[(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)], boundary=('periodic', 'periodic'))"
    )
    assert repr(operators.Heat((8,), nu=0.1, dt=0.2, length=3.0)) == "Heat(shape=(8,), nu=0.1, dt=0.2, length=(3.0,))"
    assert repr(operators.Diffusion(torch.ones(1, 8), shift=2.0, boundary=[("flux", ("robin", 0.5))])) == (
        "Diffusion(shape=(8,), kappa=tensor(1, 8), shift=2, robin_0_high=0.5, boundary=[('flux', 'robin')], "
        "length=(1.0,), faces='harmonic')"
    )
    assert repr(operators.Diffusion(torch.ones(1, 8), boundary="flux")).endswith("nullspace='constant')")
    assert repr(operators.Function(torch.neg, tensors=[C])) == "Function(neg, tensors=[tensor(2, 5, 4, 6)])"


THREE = torch.tensor([4.3, -1.0, -1.5]).view(1, 3, 1).repeat(2, 1, 16)


@pytest.mark.parametrize(("scale", "of_v"), [(1e-44, 1.0), (1e-30, 1.0), (1e-30, 1e-12), (1e30, 1e7)])
def test_products_at_the_ends_of_the_range(scale, of_v):
    c, v = THREE.clone(), of_v * torch.rand(2, 1, 16, generator=torch.Generator().manual_seed(0))
    c[0] *= scale
    found, expected = (operators.Stencil(t, [(0,), (-1,), (1,)], "zero").apply(v.to(t)) for t in (c, c.double()))
    torch.testing.assert_close(found[0].double(), expected[0], rtol=1e-5, atol=2e-45)
    torch.testing.assert_close(found[1].double(), expected[1], rtol=1e-6, atol=1e-6 * of_v)


@pytest.mark.parametrize("where", [(0, 1, 3), (0, 1, 0), (0, 2, 15), (0, 0, 0)])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_coefficient_that_is_not_finite_leaves_no_number_of_its_sample(where, value):
    """Also where it belongs to a neighbour beyond the end."""
    c, v = THREE.clone(), torch.ones(2, 1, 16)
    expected = operators.Stencil(c, [(0,), (-1,), (1,)], "zero").apply(v)[1]
    c[where] = value
    found = operators.Stencil(c, [(0,), (-1,), (1,)], "zero").apply(v)
    assert found[0].isnan().all() and torch.equal(found[1], expected)


@pytest.mark.parametrize("solver", [prdp.Jacobi(3), prdp.CG(3), prdp.GMRES(3), prdp.Direct(), prdp.Multigrid(3)])
def test_an_empty_batch_of_coefficients_gets_an_empty_gradient(solver):
    c, b = (torch.ones(0, n, 5, dtype=torch.float64, requires_grad=True) for n in (3, 1))
    u, _ = prdp.linear_solve(operators.Stencil(c, [(0,), (1,), (-1,)]), b, solver)
    u.sum().backward()
    assert c.grad.shape == c.shape and b.grad.shape == b.shape
