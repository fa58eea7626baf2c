"""`operators.Matrix.csr`: gradients at the values, never dense."""

import warnings

import pytest
import torch
from helpers import modes

import prdp_torch as prdp
from prdp_torch import _C, operators

N = 6
CROW = torch.tensor([0, 2, 5, 8, 11, 14, 16])
COL = torch.tensor([0, 1, 0, 1, 2, 1, 2, 3, 2, 3, 4, 3, 4, 5, 4, 5])


def entries(batch=None, seed=0):
    generator = torch.Generator().manual_seed(seed)
    values = torch.rand(*(() if batch is None else (batch,)), 16, dtype=torch.float64, generator=generator) - 0.5
    rows = torch.arange(N).repeat_interleave(CROW.diff())
    return values + 3.0 * (rows == COL)


def dense(values):
    rows = torch.arange(N).repeat_interleave(CROW.diff())
    matrix = torch.zeros(*values.shape[:-1], N, N, dtype=values.dtype)
    matrix[..., rows, COL] = values
    return matrix


def right_hand_side(batch=3):
    return torch.randn(batch, N, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


@modes
@pytest.mark.parametrize("batch", [None, 3])
@pytest.mark.parametrize("index", [torch.int32, torch.int64])
@pytest.mark.parametrize("solver", [prdp.Jacobi(300, rtol=1e-14), prdp.GMRES(9, restart=N, rtol=1e-14), prdp.Direct()])
def test_values_and_gradients_are_those_of_the_dense_matrix(solver, index, batch, backward):
    values, b = entries(batch).requires_grad_(), right_hand_side().requires_grad_()
    a = operators.Matrix.csr(CROW.to(index), COL.to(index), values, (N, N))
    u, info = prdp.linear_solve(a, b, solver, backward=backward)
    expected = torch.linalg.solve(dense(values), b.mT if batch is None else b[..., None])
    expected = expected.mT if batch is None else expected[..., 0]
    assert (info.status > 0).all()
    torch.testing.assert_close(u, expected)
    g = right_hand_side().cos()
    found, truth = (torch.autograd.grad(x, (values, b), g) for x in (u, expected))
    assert found[0].shape == values.shape and found[0].layout == torch.strided
    torch.testing.assert_close(found, truth, rtol=1e-9, atol=1e-12)


@modes
def test_derivatives(backward):
    values, b = entries(2).requires_grad_(), right_hand_side(2).requires_grad_()

    def solve(values, b):
        a = operators.Matrix.csr(CROW, COL, values, N)
        return prdp.linear_solve(a, b, prdp.GMRES(3, restart=N, rtol=1e-14), backward=backward)[0]

    assert torch.autograd.gradcheck(solve, (values, b))
    assert torch.autograd.gradgradcheck(solve, (values, b), fast_mode=True)


def test_products_and_parts():
    values = entries(2)
    a, m = operators.Matrix.csr(CROW, COL, values, (2, N, N)), dense(values)
    v = right_hand_side(2)
    torch.testing.assert_close(a.apply(v), (m @ v[..., None])[..., 0])
    torch.testing.assert_close(a.apply_transpose(v), (m.mT @ v[..., None])[..., 0])
    torch.testing.assert_close(a.diagonal(), m.diagonal(dim1=1, dim2=2))
    torch.testing.assert_close(a.dense(), m)
    assert prdp.check_operator(operators.Matrix.csr(CROW, COL, values.requires_grad_(), N), v)


def test_no_gradient_is_ever_dense():
    n = 20_000  # a dense gradient would take 3 GB
    crow, col = torch.arange(n + 1), torch.arange(n)
    values = torch.full((n,), 2.0).requires_grad_()
    u, _ = prdp.linear_solve(operators.Matrix.csr(crow, col, values, n), torch.ones(1, n), prdp.Jacobi(2))
    u.sum().backward()
    torch.testing.assert_close(values.grad, torch.full((n,), -0.25))


def test_a_csr_tensor_with_a_gradient_warns_once(monkeypatch):
    monkeypatch.setattr(operators.matrix, "_warned_of_csr_gradient", False)
    m, b = dense(entries()).to_sparse_csr().requires_grad_(), right_hand_side()
    with torch.no_grad():
        prdp.linear_solve(m, b, prdp.Jacobi(2))
    with pytest.warns(UserWarning, match=r"operators.Matrix.csr\(crow, col, values, size\)") as caught:
        prdp.linear_solve(m, b, prdp.Jacobi(2))
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        prdp.linear_solve(m, b, prdp.Jacobi(2))


@pytest.mark.parametrize(
    "call, error, message",
    [
        (lambda v: operators.Matrix.csr(CROW.double(), COL, v, N), TypeError, "crow must hold whole numbers"),
        (lambda v: operators.Matrix.csr(CROW, None, v, N), TypeError, "col must be a torch tensor, got NoneType"),
        (lambda v: operators.Matrix.csr(CROW, COL, COL, N), TypeError, "values must be float32 or float64"),
        (lambda v: operators.Matrix.csr(CROW, COL, v, 2.5), TypeError, "size must be a whole number, got 2.5"),
        (lambda v: operators.Matrix.csr(CROW, COL, v, (N, 5)), ValueError, r"size must be \(n, n\), .*got \(6, 5\)"),
        (lambda v: operators.Matrix.csr(CROW, COL, v, (2, N, N)), ValueError, r"values of shape \(16,\)"),
        (lambda v: operators.Matrix.csr(CROW, COL, v, 7), ValueError, r"crow must have shape \(8,\), got \(7,\)"),
        (lambda v: operators.Matrix.csr(CROW, COL[1:], v, N), ValueError, r"col must have shape \(16,\), got \(15,\)"),
    ],
)
def test_mistakes(call, error, message):
    with pytest.raises(error, match="Matrix.csr: .*" + message):
        call(entries())


@pytest.mark.filterwarnings("ignore:linear_solve. the gradient of a sparse CSR tensor", "ignore:Sparse invariant")
@pytest.mark.parametrize(("columns", "right"), [([1, 0, 1, 0], False), ([0, 0, 0, 1], False), ([0, 1, 0, 1], True)])
def test_torchs_wrong_gradient_of_unsorted_columns_is_refused(columns, right):
    values = torch.tensor([1.0, 4.0, 5.0, 2.0], dtype=torch.float64, requires_grad=True)
    crow, col, b = torch.tensor([0, 2, 4]), torch.tensor(columns), torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    matrix = torch.sparse_csr_tensor(crow, col, values, (2, 2))

    def gradient(a):
        u, _ = prdp.linear_solve(a, b, prdp.Direct())
        return torch.autograd.grad((u * torch.tensor([1.0, 3.0])).sum(), values)[0]

    exact = torch.zeros(2, 2, dtype=torch.float64).index_put((torch.arange(4) // 2, col), values, accumulate=True)
    expected = torch.autograd.grad((torch.linalg.solve(exact, b[0]) * torch.tensor([1.0, 3.0])).sum(), values)[0]
    torch.testing.assert_close(gradient(operators.Matrix.csr(crow, col, values, 2)), expected)
    if right:
        torch.testing.assert_close(gradient(matrix), expected)
    else:
        with pytest.raises(ValueError, match="the wrong values, as the columns of a row are not sorted, or repeat"):
            gradient(matrix)
        batch = torch.sparse_csr_tensor(crow.expand(3, -1), col.expand(3, -1), values.expand(3, -1), (3, 2, 2))
        with pytest.raises(ValueError, match="not sorted"):
            operators.Matrix(batch)
    with torch.no_grad():  # without a gradient nothing is wrong
        torch.testing.assert_close(prdp.linear_solve(matrix, b, prdp.Direct())[0][0], torch.linalg.solve(exact, b[0]))


@pytest.mark.filterwarnings("ignore:linear_solve. the gradient of a sparse CSR tensor", "ignore:Sparse")
def test_unsorted_columns_of_a_leaf_have_a_right_gradient():
    matrix = torch.sparse_csr_tensor(
        torch.tensor([0, 2, 4]), torch.tensor([1, 0, 1, 0]), torch.tensor([1.0, 4.0, 5.0, 2.0]).double(), (2, 2)
    ).requires_grad_()
    b, w = torch.tensor([[1.0, 2.0]]).double(), torch.tensor([1.0, 3.0]).double()
    (prdp.linear_solve(matrix * 2.0, b, prdp.Direct())[0] * w).sum().backward()
    dense = matrix.detach().to_dense().requires_grad_()
    (torch.linalg.solve(2.0 * dense, b[0]) * w).sum().backward()
    torch.testing.assert_close(matrix.grad.to_dense(), dense.grad)


@pytest.mark.filterwarnings("ignore:linear_solve. the gradient of a sparse CSR tensor", "ignore:Sparse")
def test_a_matrix_without_entries_and_one_without_memory_are_looked_at_as_well():
    values = torch.zeros(0, requires_grad=True)
    nothing = torch.sparse_csr_tensor(torch.zeros(3).long(), torch.zeros(0).long(), values, (2, 2))
    assert operators.Matrix(nothing).apply(torch.ones(1, 2)).eq(0).all()
    pattern = torch.tensor([0, 2, 4], device="meta"), torch.tensor([1, 0, 1, 0], device="meta")
    on_meta = torch.sparse_csr_tensor(*pattern, torch.ones(4, device="meta", requires_grad=True), (2, 2))
    assert operators.Matrix(on_meta).kind == "csr"


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("form", ["one matrix", "values of each", "pattern of each"])
@pytest.mark.parametrize("batch, n", [(1, 1), (3, 17), (9, 700)])
def test_the_gradient_of_the_values_is_the_outer_product_at_their_places(form, batch, n, dtype, threads):
    generator = torch.Generator().manual_seed(n)
    patterns = (torch.rand(1 if form != "pattern of each" else batch, n, n, generator=generator) < 4 / n).to(dtype)
    count = int(patterns.sum((1, 2)).min()) if len(patterns) > 1 else None
    entries = [p.nonzero()[:count] for p in patterns]
    crow = torch.stack([torch.searchsorted(e[:, 0].contiguous(), torch.arange(n + 1)) for e in entries])
    col = torch.stack([e[:, 1] for e in entries])
    values = torch.rand(*(() if form == "one matrix" else (batch,)), col.shape[1], generator=generator, dtype=dtype)
    lam, u = (torch.rand(batch, n, generator=generator, dtype=dtype) for _ in range(2))
    if len(patterns) == 1:
        crow, col = crow[0], col[0]
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.no_grad():
            found = _C.product_rule(lam, u, [crow, col, values], "csr", [], [])[2]
    finally:
        torch.set_num_threads(before)
    outer = [lam[s, e[:, 0]] * u[s, e[:, 1]] for s in range(batch) for e in [entries[s % len(entries)]]]
    expected = sum(outer) if form == "one matrix" else torch.stack(outer)
    torch.testing.assert_close(found, expected, rtol=1e-6 if dtype == torch.float32 else 1e-14, atol=0.0)
