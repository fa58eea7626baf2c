"""Operators against matrices that numpy builds on its own."""

import numpy as np
import pytest
import torch
from helpers import dense_heat, dense_laplacian, field, golden, spd_matrices
from hypothesis import given, settings
from hypothesis import strategies as st

import prdp_torch as prdp
from prdp_torch import operators

# Sizes that are no multiples of the vector width, and single points.
SHAPES = [(1,), (7,), (17,), (30,), (33,), (5, 18), (1, 4), (16, 3), (4, 3, 7), (2, 1, 17)]
shapes = st.lists(st.integers(1, 9), min_size=1, max_size=3).map(tuple)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_stencils_equal_their_matrices(shape):
    v = field(shape, batch=3)
    flat = v.flatten(1).numpy()
    for a, matrix in (
        (operators.Poisson(shape), dense_laplacian(shape)),
        (operators.Heat(shape, 2e-3, 0.5), dense_heat(shape, 2e-3, 0.5)),
    ):
        np.testing.assert_allclose(a.apply(v).flatten(1), flat @ matrix.T, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(a.apply_transpose(v).flatten(1), flat @ matrix, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(a.dense(), matrix, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(np.broadcast_to(a.diagonal().numpy(), len(matrix)), np.diag(matrix), rtol=1e-12)


@settings(deadline=None, max_examples=40)
@given(shape=shapes, nu=st.floats(0, 10), dt=st.floats(1e-6, 10))
def test_transpose_satisfies_the_dot_product_identity(shape, nu, dt):
    u, v = field(shape, seed=1), field(shape, seed=2)
    for a in (operators.Poisson(shape), operators.Heat(shape, nu, dt)):
        left, right = (a.apply(u) * v).sum(), (u * a.apply_transpose(v)).sum()
        torch.testing.assert_close(left, right, rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("sparse", [False, True])
def test_matrices_apply_like_torch(batched, sparse):
    generator = torch.Generator().manual_seed(0)
    m = torch.randn(3, 5, 5, generator=generator, dtype=torch.float64)
    m[:, 0, 1] = m[:, 4, 2] = 0.0
    m = m if batched else m[0]
    v = torch.randn(3, 5, generator=generator, dtype=torch.float64)
    a = operators.Matrix(m.to_sparse_csr() if sparse else m)
    expected = (m @ v.unsqueeze(-1)).squeeze(-1)
    expected_transpose = (m.mT @ v.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(a.apply(v), expected)
    torch.testing.assert_close(a.apply_transpose(v), expected_transpose)
    torch.testing.assert_close(a.diagonal(), m.diagonal(dim1=-2, dim2=-1))
    torch.testing.assert_close(a.dense(), m)


@pytest.mark.parametrize("name, shape", [("heat1d", (30,)), ("heat2d", (30, 30))])
def test_heat_operator_equals_the_published_code(name, shape):
    g = golden(name)
    u = torch.tensor(g["u"]).view(3, 1, *shape)
    product = operators.Heat(shape, 1e-3, 1.0).apply(u)
    np.testing.assert_allclose(product.flatten(1), g["matvec"], rtol=0, atol=1e-10)


@pytest.mark.parametrize("n", [9, 19, 20, 63, 100])
def test_a_shared_matrix_as_preconditioner_gives_a_sample_its_own_bits(n):
    a = spd_matrices(1, n)[0]
    inverse = torch.linalg.inv(a + 0.1 * torch.eye(n, dtype=torch.float64))
    solver = prdp.CG(3, 0.0, preconditioner=operators.Matrix(inverse))
    b = torch.randn(5, n, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    u, info = prdp.linear_solve(a, b, solver, backward="unrolled")
    assert info.residual.max() < 0.1
    torch.testing.assert_close(b @ torch.linalg.inv(a), u, rtol=0.1, atol=0.1 * u.abs().max().item())
    for some in (slice(1), slice(3, 5)):
        assert torch.equal(prdp.linear_solve(a, b[some], solver)[0], u[some])
    (gradient,) = torch.autograd.grad(u.sum(), b)
    (alone,) = torch.autograd.grad(prdp.linear_solve(a, b[:1], solver, backward="unrolled")[0].sum(), b)
    torch.testing.assert_close(gradient[0], alone[0], rtol=1e-9, atol=1e-12)


def test_apply_differentiates_with_respect_to_field_and_viscosity():
    nu = torch.tensor(3e-3, dtype=torch.float64, requires_grad=True)
    v = field((4, 3)).requires_grad_()
    assert torch.autograd.gradcheck(lambda v, nu: operators.Heat((4, 3), nu, 0.7).apply(v), (v, nu))


def test_stencils_take_any_strides():
    v = field((6, 7)).transpose(2, 3).contiguous().transpose(2, 3)
    assert not v.is_contiguous()
    a = operators.Heat((6, 7), 1e-3, 1.0)
    assert torch.equal(a.apply(v), a.apply(v.contiguous()))


def test_dense_of_batched_matrices_keeps_the_batch():
    m = spd_matrices(4, 3)
    assert torch.equal(operators.Matrix(m).dense(), m)


def test_operators_say_what_is_wrong():
    with pytest.raises(ValueError, match=r"Heat: nu must be finite and >= 0, got -0.001"):
        operators.Heat((30,), -1e-3, 1.0)
    with pytest.raises(ValueError, match=r"Heat: dt must be finite and > 0, got 0"):
        operators.Heat((30,), 1e-3, 0.0)
    with pytest.raises(ValueError, match=r"Heat: nu must be finite and >= 0, got nan"):
        operators.Heat((30,), float("nan"), 1.0)
    with pytest.raises(
        ValueError, match=r"Heat: nu must be a number, a 0-dimensional tensor, or \(batch,\), one for each"
    ):
        operators.Heat((30,), torch.ones(2, 1), 1.0)
    with pytest.raises(ValueError, match=r"Poisson: shape must have 1, 2 or 3 extents, got \[1, 2, 3, 4\]"):
        operators.Poisson((1, 2, 3, 4))
    with pytest.raises(ValueError, match=r"Poisson: every extent of shape must be >= 1, got \[3, 0\]"):
        operators.Poisson((3, 0))
    with pytest.raises(ValueError, match=r"Heat: expected \(batch, 1, 30\), got \(25, 30\)"):
        operators.Heat((30,), 1e-3, 1.0).apply(torch.zeros(25, 30))
    with pytest.raises(ValueError, match=r"A must have shape \(n, n\) or \(batch, n, n\), got \(2, 3\)"):
        operators.Matrix(torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"A must be a dense or sparse CSR tensor, got torch\.sparse_coo"):
        operators.Matrix(torch.eye(3).to_sparse())


def test_public_names_are_the_contract():
    assert {"Heat", "Poisson", "Jacobi", "SteepestDescent", "CG", "Direct", "linear_solve"} <= set(prdp.__all__)
