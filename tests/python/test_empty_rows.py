"""A row of A that is zero, as that of a node in no element, is named by whatever fails on it."""

import pytest
import torch
from helpers import statuses

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def chain(*empty, n=300):
    """Springs between neighbours, and nodes that none is fixed to."""
    a = 3 * torch.eye(n, dtype=F64) - torch.diag(torch.ones(n - 1), 1) - torch.diag(torch.ones(n - 1), -1)
    for i in empty:
        a[i] = a[:, i] = 0.0
    return a


SOLVERS = [
    prdp.Direct(),
    prdp.CG(900),
    prdp.CG(900, preconditioner="diagonal"),
    prdp.GMRES(90),
    prdp.Jacobi(90),
]


@pytest.mark.parametrize("solver", SOLVERS, ids=repr)
@pytest.mark.parametrize("form", [lambda a: a, torch.Tensor.to_sparse_csr], ids=["dense", "csr"])
def test_the_error_names_the_row(form, solver):
    b = torch.ones(2, 300, dtype=F64)
    with pytest.raises(
        torch.linalg.LinAlgError, match=r"row \(21,\) of A is zero, as those of a node in no element are"
    ):
        prdp.linear_solve(form(chain(21)), b, solver)
    with pytest.raises(
        torch.linalg.LinAlgError, match=r"2 rows of A are zero, such as \(21,\).* put 1 on the diagonal"
    ):
        prdp.linear_solve(form(chain(21, 250)), b, solver)


def test_a_column_is_named_too():
    a = chain()
    a[:, 5] = 0.0
    with pytest.raises(torch.linalg.LinAlgError, match=r"column \(5,\) of A is zero"):
        prdp.linear_solve(a, torch.ones(1, 300, dtype=F64), prdp.Direct())


def test_the_sample_with_the_row_is_the_one_that_is_told_of():
    a = torch.stack([chain(), chain(7)])
    with pytest.raises(torch.linalg.LinAlgError, match=r"sample 1 BREAKDOWN.*row \(7,\) of A is zero"):
        prdp.linear_solve(a, torch.ones(2, 300, dtype=F64), prdp.Direct())


@pytest.mark.parametrize("form", [lambda a: a, torch.Tensor.to_sparse_csr], ids=["dense", "csr"])
def test_what_the_remedy_names_solves(form):
    a, b = chain(21, 250), torch.ones(1, 300, dtype=F64)
    b[0, [21, 250]] = 0.0
    for i in (21, 250):
        a[i, i] = 1.0
    u, _ = prdp.linear_solve(form(a), b, prdp.Direct())
    torch.testing.assert_close(u[0], torch.linalg.solve(a, b[0]), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("solver", [None, prdp.Direct(), prdp.CG(9)])
def test_the_check_of_an_operator_names_it(solver):
    b = torch.ones(2, 300, dtype=F64)
    with pytest.raises(ValueError, match=r"row \(21,\) of A is zero: put 1 on the diagonal there"):
        prdp.check_operator(chain(21), b, solver)
    with pytest.raises(ValueError, match=r"2 rows of A are zero, such as \(21,\)"):
        prdp.check_operator(operators.Function(lambda v, a: v @ a, tensors=chain(21, 250), symmetric=True), b, solver)
    assert prdp.check_operator(chain(), b, solver)


def test_a_node_that_is_named_as_null_vector_is_no_mistake():
    e = torch.zeros(1, 300, dtype=F64)
    e[0, 21] = 1.0
    b = torch.ones(1, 300, dtype=F64)
    b[0, 21] = 0.0
    a = operators.Matrix(chain(21), nullspace=e)
    u, info = prdp.linear_solve(a, b, prdp.CG(900))
    assert prdp.check_operator(a, b) and info.solved.all()
    torch.testing.assert_close(u[0], torch.linalg.pinv(chain(21)) @ b[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("make", [prdp.MINRES, lambda k, **of: prdp.GMRES(k // 2, restart=2, **of)])
def test_more_products_than_unknowns_far_from_rtol_are_told(make, always):
    """A Krylov method would have ended; fewer may be all that was wanted."""
    a, b = torch.diag(torch.logspace(0, 13, 100, dtype=F64)), torch.ones(1, 100, dtype=F64)
    prdp.linear_solve(a, b, make(40))
    with pytest.warns(UserWarning, match=r"did not reach rtol = 1e-05: sample 0 is at relative residual 0\.\d+ after"):
        prdp.linear_solve(a, b, make(120))
    prdp.linear_solve(a, b, make(120, rtol=0.0))
    prdp.linear_solve(a, b, make(120), on_failure="return")


@pytest.mark.filterwarnings("ignore:.* did not reach rtol", "ignore:.* ended far above rtol")
@pytest.mark.parametrize("form", [lambda a: a, torch.Tensor.to_sparse_csr], ids=["dense", "csr"])
@pytest.mark.parametrize("iterations", [20, 100, 1000])
def test_minres_hands_out_the_least_residual_where_b_cannot_be_met(iterations, form):
    """Later, u grows along the null vector to 1e16, and the true residual with it."""
    a = chain(7, n=60)
    b = -torch.ones(3, 60, dtype=F64)
    b[1] *= 1e-9
    b[2, 7] = 0.0  # solvable
    u, info = prdp.linear_solve(form(a), b, prdp.MINRES(iterations))
    assert statuses(info) == ["MAX_ITER", "MAX_ITER", "CONVERGED"]
    assert (info.residual[:2] < 1.01 * 60**-0.5).all() and (u.abs().amax(1) < 30 * b.abs().amax(1)).all()
    torch.testing.assert_close(info.residual[:2], (b - u @ a).norm(dim=1)[:2] / b.norm(dim=1)[:2])
