"""Burgers and Navier-Stokes operators, against matrices that numpy builds entry by entry."""

import numpy as np
import pytest
import torch
from helpers import dense_burgers, dense_navier_stokes, field, golden, statuses
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp
from prdp_torch import operators

F = golden("failures")
GRIDS_1D = [(2,), (3,), (7,), (17,), (33,)]
GRIDS_2D = [(2, 2), (3, 2), (5, 18), (9, 4)]
CASES = [(operators.Burgers, dense_burgers, shape, len(shape), len(shape)) for shape in GRIDS_1D + GRIDS_2D]
CASES += [(operators.NavierStokes, dense_navier_stokes, shape, w, 3) for shape in GRIDS_2D for w in (2, 3)]
cases = pytest.mark.parametrize(
    "kind, dense, shape, wind_channels, channels", CASES, ids=lambda case: getattr(case, "__name__", str(case))
)


@cases
@pytest.mark.parametrize("batch", [1, 3])
def test_operators_equal_their_matrices(kind, dense, shape, wind_channels, channels, batch):
    winds, v = field(shape, batch, channels=wind_channels), field(shape, 3, seed=1, channels=channels)
    a = kind(winds, 2e-3, 0.3)
    matrices = np.stack([dense(w.numpy(), 2e-3, 0.3) for w in winds.expand(3, -1, *shape)])
    flat = v.flatten(1).numpy()
    close = {"rtol": 1e-12, "atol": 1e-11}
    np.testing.assert_allclose(a.apply(v).flatten(1), np.einsum("bij,bj->bi", matrices, flat), **close)
    np.testing.assert_allclose(a.apply_transpose(v).flatten(1), np.einsum("bji,bj->bi", matrices, flat), **close)
    np.testing.assert_allclose(a.dense(), matrices if batch == 3 else matrices[0], **close)
    diagonal = a.diagonal().expand(v.shape).flatten(1)
    np.testing.assert_allclose(diagonal, np.einsum("bii->bi", matrices), **close)


@pytest.mark.parametrize("kind, channels", [(operators.Burgers, 2), (operators.NavierStokes, 3)])
def test_float32_is_close_and_stays_float32(kind, channels):
    winds, v = field((6, 7), channels=channels), field((6, 7), seed=1, channels=channels)
    a, single = kind(winds, 2e-3, 0.3), kind(winds.float(), 2e-3, 0.3)
    for expected, found in (
        (a.apply(v), single.apply(v.float())),
        (a.apply_transpose(v), single.apply_transpose(v.float())),
        (a.diagonal(), single.diagonal()),
    ):
        torch.testing.assert_close(found, expected.float(), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("kind, channels", [(operators.Burgers, 2), (operators.NavierStokes, 3)])
def test_any_strides_of_winds_and_vector(kind, channels):
    winds, v = (field((7, 6), seed=s, channels=channels).transpose(2, 3) for s in (0, 1))
    assert not v.is_contiguous()
    whole = kind(winds.contiguous(), 2e-3, 0.3).apply(v.contiguous())
    assert torch.equal(kind(winds, 2e-3, 0.3).apply(v), whole)


@settings(deadline=None, max_examples=30)
@given(shape=st.lists(st.integers(2, 8), min_size=1, max_size=2), nu=st.floats(0, 1), dt=st.floats(1e-3, 10))
def test_transpose_satisfies_the_dot_product_identity(shape, nu, dt):
    kinds = [(operators.Burgers, len(shape))] + [(operators.NavierStokes, 3)] * (len(shape) == 2)
    for kind, channels in kinds:
        winds, u, v = (field(shape, seed=s, channels=channels) for s in range(3))
        a = kind(winds, nu, dt)
        torch.testing.assert_close((a.apply(u) * v).sum(), (u * a.apply_transpose(v)).sum(), rtol=1e-11, atol=1e-8)


def test_burgers_equals_the_published_code():
    g = {name: torch.tensor(a) for name, a in golden("burgers1d").items()}
    u, v = g["u"][:, None], g["v"][:, None]
    a = operators.Burgers(u, 1e-3, 0.01)
    np.testing.assert_allclose(a.apply(v)[:, 0], g["matvec"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(a.apply_transpose(v)[:, 0], g["rmatvec"], rtol=0, atol=1e-12)
    step = prdp.Burgers((256,), 1e-3, 0.01, solver=prdp.Direct())
    assert torch.equal(step.rhs(u)[:, 0], g["rhs"])
    assert torch.equal(step.operator(u).apply(v), a.apply(v))


@pytest.mark.parametrize("case", ["B02_0", "D05"])
def test_burgers_equals_independent_matrices(case):
    winds = torch.tensor(F[f"{case}__w"])[None, None]
    a = operators.Burgers(winds, float(F[f"{case}__nu"]), float(F[f"{case}__dt"])).dense()
    np.testing.assert_allclose(a, F[f"{case}__A"], rtol=1e-12, atol=1e-12)


def test_navier_stokes_equals_an_independent_implementation():
    g = {name: torch.tensor(a) for name, a in golden("ns10").items()}
    step = prdp.NavierStokes((10, 10), 1e-4, 0.1, solver=prdp.Direct())
    a = step.operator(g["u_prev"])
    np.testing.assert_allclose(a.apply(g["v"]), g["matvec"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(a.apply_transpose(g["v"]), g["rmatvec"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(step.rhs(g["u_prev"]), g["rhs"], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "kind, shape, wind_channels, channels",
    [
        (operators.Burgers, (5,), 1, 1),
        (operators.Burgers, (3, 2), 2, 2),
        (operators.NavierStokes, (3, 4), 2, 3),
        (operators.NavierStokes, (2, 3), 3, 3),
    ],
)
@pytest.mark.parametrize("batch", [1, 2])
def test_products_differentiate_with_respect_to_vector_winds_and_viscosity(kind, shape, wind_channels, channels, batch):
    winds = field(shape, batch, channels=wind_channels).requires_grad_()
    v = field(shape, seed=1, channels=channels).requires_grad_()
    nu = torch.tensor(3e-2, dtype=torch.float64, requires_grad=True)
    for product in ("apply", "apply_transpose"):

        def f(v, winds, nu, product=product):
            return getattr(kind(winds, nu, 0.2), product)(v)

        assert gradcheck(f, (v, winds, nu)) and gradgradcheck(f, (v, winds, nu), fast_mode=True)


@pytest.mark.parametrize("kind, channels", [(operators.Burgers, 1), (operators.NavierStokes, 3)])
@pytest.mark.parametrize("backward", ["apply", "implicit", "unrolled"])
def test_at_a_wind_of_zero_the_derivative_is_the_mean_of_both_sides(kind, channels, backward):
    shape = (5,) if channels == 1 else (3, 4)
    b, g = (field(shape, batch=1, seed=s, channels=channels) for s in (1, 2))
    if channels == 3:  # consistent
        b[:, 2] -= b[:, 2].mean()
        g[:, 2] -= g[:, 2].mean()

    def gradient(level):
        winds = torch.full((1, channels, *shape), level, dtype=torch.float64, requires_grad=True)
        a = kind(winds, 1e-2, 0.2)
        out = a.apply(b) if backward == "apply" else prdp.linear_solve(a, b, prdp.Direct(), backward=backward)[0]
        return torch.autograd.grad(out, winds, g)[0]

    below, at_zero, above = (gradient(level) for level in (-1e-9, 0.0, 1e-9))
    assert (above - below).abs().max() > 1e-2
    torch.testing.assert_close(at_zero, (below + above) / 2, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("batch", [1, 2])
def test_winds_that_are_not_finite_are_found_and_not_swallowed(batch):
    for kind, channels, shape in ((operators.Burgers, 1, (6,)), (operators.NavierStokes, 3, (4, 5))):
        for bad in (float("nan"), float("inf")):
            winds = field(shape, batch, channels=channels)
            where = (channels - 1 if channels == 1 else 1, *(n - 2 for n in shape))
            winds[batch - 1][where] = bad
            b = field(shape, channels=channels)
            assert kind(winds, 1e-3, 0.1).apply(b)[1].isnan().any()
            u, info = prdp.linear_solve(kind(winds, 1e-3, 0.1), b, prdp.Direct(), on_failure="return")
            assert statuses(info)[1] == "NONFINITE_OPERATOR" and not u[1].any()
            assert batch == 1 or u[0].any()
            message = f"NONFINITE_OPERATOR at index \\({', '.join(map(str, where))}\\)"
            with pytest.raises(torch.linalg.LinAlgError, match=message):
                prdp.linear_solve(kind(winds, 1e-3, 0.1), b, prdp.Direct())


@pytest.mark.parametrize("batch", [1, 2])
def test_jacobi_refuses_the_pressure_rows_of_navier_stokes(batch):
    a = operators.NavierStokes(field((4, 5), batch, channels=2), 1e-3, 0.1)
    with pytest.raises(torch.linalg.LinAlgError, match=r"ZERO_DIAGONAL in row \(2, 0, 0\)"):
        prdp.linear_solve(a, field((4, 5), channels=3), prdp.Jacobi(5))


def test_burgers_rows_sum_to_one_with_no_positive_entry_off_the_diagonal():
    a = operators.Burgers(10 * field((5, 6), channels=2), 1e-3, 0.1).dense()
    torch.testing.assert_close(a.sum(-1), torch.ones(2, 60, dtype=torch.float64), rtol=0, atol=1e-12)
    assert (a - torch.diag_embed(a.diagonal(dim1=1, dim2=2))).max() <= 0


def test_constant_pressure_is_the_null_space_of_navier_stokes():
    a = operators.NavierStokes(field((4, 5), channels=2), 1e-3, 0.1)
    p = torch.zeros(2, 3, 4, 5, dtype=torch.float64)
    p[:, 2] = 1.5  # whose products with 1/dx are exact
    assert not a.apply(p).any() and not a.apply_transpose(p).any()
    assert (torch.linalg.matrix_rank(a.dense()) == 3 * 20 - 1).all()


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: operators.Burgers(field((8,)), -1e-3, 0.1), "Burgers: nu must be finite and >= 0, got -0.001"),
        (lambda: operators.Burgers(field((8,)), 1e-3, 0.0), "Burgers: dt must be finite and > 0, got 0"),
        (lambda: operators.NavierStokes(field((8, 8), channels=2), 1e-3, -1.0), "NavierStokes: dt must be finite"),
        (lambda: operators.Burgers(field((8, 8)), 1e-3, 0.1), r"Burgers: expected \(batch, 2, 8, 8\), got"),
        (lambda: operators.Burgers(torch.zeros(2, 8), 1e-3, 0.1), r"winds must have shape \(batch, channel, \*shape\)"),
        (lambda: operators.Burgers(field((2, 3, 4), channels=3), 0.0, 0.1), "Burgers: shape must have 1 or 2 extents"),
        (lambda: operators.Burgers(field((1,)), 1e-3, 0.1), r"Burgers: every extent of shape must be >= 2, got \[1\]"),
        (lambda: operators.NavierStokes(field((8,)), 1e-3, 0.1), r"NavierStokes: shape must have 2 extents, got \[8\]"),
        (lambda: operators.NavierStokes(field((4, 4)), 1e-3, 0.1), r"NavierStokes: expected \(batch, 3, 4, 4\), got"),
    ],
)  # fmt: skip
def test_operators_say_what_is_wrong(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_vector_and_winds_must_fit():
    a = operators.Burgers(field((8,), batch=3), 1e-3, 0.1)
    with pytest.raises(ValueError, match="Burgers: the winds hold 3 samples, the vector holds 2"):
        a.apply(field((8,)))
    with pytest.raises(ValueError, match="Burgers: the winds hold 3 samples, the vector holds 2"):
        prdp.linear_solve(a, field((8,)), prdp.Jacobi(3))
    with pytest.raises(TypeError, match="Burgers: the winds are float64 but the vector is float32"):
        a.apply(field((8,), batch=3).float())
    with pytest.raises(ValueError, match="Burgers: the winds are on cpu but the vector is on meta"):
        a.apply(field((8,), batch=3).to("meta"))
    with pytest.raises(TypeError, match="Burgers: winds must be a torch tensor, got list"):
        operators.Burgers([1.0], 1e-3, 0.1)
