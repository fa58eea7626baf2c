"""Matrices whose rows or columns differ much in size: what is small is judged by its own row and column."""

import numpy as np
import pytest
import torch
from helpers import statuses
from hypothesis import given, settings
from hypothesis import strategies as st

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def noise(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def second_differences(n, diagonal=2.0):
    beside = torch.ones(n - 1, dtype=F64)
    return diagonal * torch.eye(n, dtype=F64) - torch.diag(beside, 1) - torch.diag(beside, -1)


def on_a_square(n):
    unit = torch.eye(n, dtype=F64)
    return torch.kron(second_differences(n, 2.1), unit) + torch.kron(unit, second_differences(n))


def as_stencil(m):
    """A tridiagonal matrix."""
    rows = [m.diagonal(), *(torch.zeros(len(m), dtype=m.dtype) for _ in range(2))]
    rows[1][1:], rows[2][:-1] = m.diagonal(-1), m.diagonal(1)
    return operators.Stencil(torch.stack(rows)[None], [(0,), (-1,), (1,)])


FORMS = {"dense": operators.Matrix, "csr": lambda m: operators.Matrix(m.to_sparse_csr()), "stencil": as_stencil}


def solve(form, m, b, solver, **options):
    """u and its report, for b (n,)."""
    rhs = b.view(1, 1, -1) if form == "stencil" else b.view(1, -1)
    u, info = prdp.linear_solve(FORMS[form](m), rhs, solver, **options)
    return u.flatten(), info


def with_penalties(size, n=50):
    m = second_differences(n)
    for i in (0, 20, n - 1):
        m[i, i] += size
    return m


def bar(n=400, stiffness=8e13):
    """A steel bar of n elements: the displacement of its first node is given, a force pulls at the last."""
    m = stiffness * second_differences(n)
    m[0], m[0, 0], m[-1, -1] = 0.0, 1.0, stiffness
    b = torch.zeros(n, dtype=F64)
    b[0], b[-1] = 1e-3, 1e3
    return m, b, 1e-3 + 1e3 / stiffness * torch.arange(n, dtype=F64)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("size", [1e20, 1e30])
@pytest.mark.parametrize("values", [False, True])
def test_direct_solves_with_values_by_penalty_as_lapack_does(size, values, form):
    m, b = with_penalties(size), torch.ones(50, dtype=F64)
    if values:
        b[0], b[20], b[-1] = size * torch.tensor([1.0, 2.0, 3.0], dtype=F64)
    b.requires_grad_()
    u, info = solve(form, m, b, prdp.Direct())
    torch.testing.assert_close(u, torch.linalg.solve(m, b).detach(), rtol=1e-13, atol=0)
    (u * noise(50)).sum().backward()
    torch.testing.assert_close(b.grad, torch.linalg.solve(m.T, noise(50)), rtol=1e-12, atol=0)
    assert statuses(info) == ["CONVERGED"]


@pytest.mark.parametrize("form", FORMS)
def test_direct_solves_a_bar_with_a_row_of_one_beside_its_stiffness(form):
    m, b, exact = bar()
    u, info = solve(form, m, b, prdp.Direct())
    torch.testing.assert_close(u, exact, rtol=1e-11, atol=0)
    assert statuses(info) == ["CONVERGED"]


@pytest.mark.parametrize("form", ["dense", "csr"])
@pytest.mark.parametrize("lines", ["rows", "columns", "both"])
def test_direct_solves_lines_of_sixteen_decades_as_lapack_does(lines, form):
    m, sizes = noise(40, 40) + 8 * torch.eye(40), 10 ** torch.linspace(-8, 8, 40, dtype=F64)
    b = noise(40, seed=1)
    if lines != "columns":
        m, b = sizes[:, None] * m, sizes * b
    if lines != "rows":
        m = m * sizes.flip(0)
    u, info = solve(form, m, b, prdp.Direct())
    exact = torch.linalg.solve(m, b)
    scale = 1.0 if lines == "rows" else sizes.flip(0)
    assert ((u - exact) * scale).norm() <= 1e-13 * (exact * scale).norm()
    assert statuses(info) == ["CONVERGED"]


@st.composite
def scaled_systems(draw):
    """A regular matrix and the exponents of powers of two up to 1e±30 for its rows and columns."""
    form, n = draw(st.sampled_from(["dense", "csr", "stencil"])), 36
    seed = draw(st.integers(0, 2**20))
    generator = np.random.default_rng(seed)
    if form == "stencil":
        m = second_differences(n, 2.1)
    else:
        m = draw(st.sampled_from([noise(n, n, seed=seed) + 8 * torch.eye(n), on_a_square(6)]))

    def exponents():
        kind = draw(st.sampled_from(["none", "few", "any", "rising"]))
        found = np.round(generator.uniform(-100, 100, n))
        if kind == "few":
            found *= generator.random(n) < 0.1
        return torch.tensor({"none": 0.0 * found, "rising": np.sort(found)}.get(kind, found))

    return form, m, exponents(), exponents(), noise(n, seed=seed + 1)


@settings(deadline=None, max_examples=60)
@given(system=scaled_systems())
def test_powers_of_two_for_rows_and_columns_pass_through_a_direct_solve(system):
    form, m, of_rows, of_columns, x = system
    rows, columns = 2.0**of_rows, 2.0**of_columns
    scaled = rows[:, None] * m * columns
    b = (rows * (m @ x)).requires_grad_()
    u, info = solve(form, scaled, b, prdp.Direct(2, rtol=1e-300))
    assert (u.detach() * columns - x).norm() <= 1e-6 * x.norm()
    u.backward(columns * (m.T @ x))
    assert (b.grad * rows - x).norm() <= 1e-6 * x.norm()
    assert statuses(info)[0] in ("MAX_ITER", "STAGNATED", "CONVERGED")


@settings(deadline=None, max_examples=30)
@given(form=st.sampled_from(["dense", "csr"]), seed=st.integers(0, 2**20), size=st.sampled_from([0, 20, 60]))
def test_a_singular_matrix_breaks_down_however_it_is_scaled(form, seed, size):
    n = 12
    generator = np.random.default_rng(seed)
    rows, columns = (torch.tensor(2.0 ** np.round(generator.uniform(-size, size, n))) for _ in range(2))
    ring = second_differences(n)
    ring[0, -1] = ring[-1, 0] = -1.0
    for m in (noise(n, n - 1, seed=seed) @ noise(n - 1, n, seed=seed + 1), ring):
        _, info = solve(form, rows[:, None] * m * columns, rows * noise(n, seed=2), prdp.Direct(), on_failure="return")
        assert statuses(info) == ["BREAKDOWN"]


@pytest.mark.parametrize("solver", [prdp.GMRES(10, 1e-10, restart=50), prdp.CG(200, 1e-10)])
def test_what_cannot_solve_with_a_penalty_says_why(solver):
    with pytest.raises(torch.linalg.LinAlgError, match=r"badly scaled rows: the largest is .* times the smallest"):
        solve("dense", with_penalties(1e30), torch.ones(50, dtype=F64), solver)


@pytest.mark.filterwarnings("ignore:.* did not reach rtol")
@pytest.mark.parametrize(
    "solver",
    [
        prdp.CG(50, preconditioner="multigrid"),
        prdp.GMRES(5, restart=20, preconditioner="multigrid"),
        prdp.Multigrid(50),
        prdp.BiCGStab(200),
        prdp.GMRES(10, restart=50),
        prdp.Direct(),
    ],
)
def test_no_method_says_that_a_regular_bar_maps_the_constant_to_zero(solver):
    m, b, _ = bar()
    try:
        info = solve("stencil", m, b, solver)[1]
    except torch.linalg.LinAlgError as error:
        assert "badly scaled rows" in str(error) and "nullspace" not in str(error)
    else:
        assert "INCONSISTENT" not in statuses(info)


def test_the_check_of_an_operator_sees_the_row_that_holds_the_constant():
    m = bar()[0]
    assert prdp.check_operator(operators.Matrix(m), noise(1, len(m)))
    m[0, 0] = 0.0
    m[0, :2] = torch.tensor([1.0, -1.0])
    with pytest.raises(ValueError, match="A maps the constant to zero"):
        prdp.check_operator(operators.Matrix(m), noise(1, len(m)))


@pytest.mark.parametrize("restart", [5, 10, 20])
@pytest.mark.parametrize("seed", range(6))
def test_what_is_called_solved_is_so_where_columns_differ_by_nine_decades(seed, restart):
    n = 20
    sizes = 10 ** (-9 * torch.rand(n, dtype=F64, generator=torch.Generator().manual_seed(seed)))
    m = ((noise(n, n, seed=seed) + 8 * torch.eye(n)) * sizes).float()
    b = noise(n, seed=seed + 1, dtype=torch.float32)
    u, info = solve("dense", m, b, prdp.GMRES(50, 1e-6, restart=restart), on_failure="return")
    exact = torch.linalg.solve(m.double(), b.double())
    assert not info.solved or (u - exact).norm() <= 1e-2 * exact.norm()
    assert not info.solved or info.residual <= 0.1


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-11), (torch.float32, 1e-3)])
@pytest.mark.parametrize("penalty", [1e6, 1e14, 1e30])
def test_a_penalty_along_a_whole_line_is_no_constant_coefficient(penalty, dtype, tolerance):
    """A is a sum over the axes then, but what one of them holds is rounding beside the penalty."""
    shift = torch.zeros(1, 12, 12, dtype=dtype)
    shift[0, 0] = penalty
    a = operators.Diffusion(torch.ones_like(shift), shift=shift)
    b = torch.ones(2, 1, 12, 12, dtype=dtype)
    u, info = prdp.linear_solve(a, b, prdp.Direct(2), on_failure="return")
    dense = operators.Diffusion(torch.ones_like(shift).double(), shift=shift.double()).dense()
    expected = torch.linalg.solve(dense, b.double().flatten(1).mT).mT.view_as(b)
    inner = slice(1, None)  # where u is not of the order of 1/penalty
    error = (u.double() - expected)[..., inner, :].abs().max() / expected.abs().max()
    assert error <= tolerance and not info.failed.any()
