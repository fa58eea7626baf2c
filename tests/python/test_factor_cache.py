"""`Direct` on sparse matrices: one factorisation for all samples, steps and adjoint solves of one matrix."""

import subprocess
import sys

import pytest
import torch
from helpers import dense_heat, statuses

import prdp_torch as prdp
from prdp_torch import _C, operators

FIVE = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
SHAPE = (6, 5)


def stencil(symmetric, seed=0, requires_grad=False):
    """I - ∇·(κ ∇) with κ on the cells, or any dominant coefficients."""
    torch.manual_seed(seed)
    c = torch.rand(1, 5, *SHAPE, dtype=torch.float64)
    if symmetric:
        faces = [c[:, k] + c[:, k].roll(-1, axis) for k, axis in ((1, -1), (2, -2))]
        x, y = faces[0], faces[1]
        before = x.roll(1, -1), y.roll(1, -2)
        c = torch.stack([1 + x + y + sum(before), -before[0], -x, -before[1], -y], 1)
    else:
        c[:, 0] += 5
    return operators.Stencil(c.requires_grad_(requires_grad), FIVE, "periodic")


def csr(symmetric, seed=0, requires_grad=False):
    m = stencil(symmetric, seed).dense().to_sparse_csr()
    values = m.values().clone().requires_grad_(requires_grad)
    return operators.Matrix.csr(m.crow_indices(), m.col_indices(), values, m.shape)


def rhs(a, batch, seed=1):
    torch.manual_seed(seed)
    shape = (batch, 30) if isinstance(a, operators.Matrix) else (batch, 1, *SHAPE)
    return torch.randn(shape, dtype=torch.float64)


def factorisations(work):
    _C.clear_factorisations()
    before = _C.count_factorisations()
    work()
    return _C.count_factorisations() - before


@pytest.mark.parametrize("make", [stencil, csr])
@pytest.mark.parametrize("symmetric", [True, False], ids=["symmetric", "not symmetric"])
def test_a_rollout_factorises_its_operator_once(make, symmetric):
    a = make(symmetric, requires_grad=True)
    step = prdp.ImplicitStep(a, solver=prdp.Direct())
    u = rhs(a, 3)
    made = factorisations(lambda: step.rollout(u, 4).square().sum().backward())
    assert made == 1  # the factors of A are those of its transpose

    (values,) = (t for t in a.tensors if t.requires_grad)
    states = [u.reshape(3, 30)]
    for _ in range(4):
        states.append(solved(dense(a, values), states[-1]))
    torch.testing.assert_close(step.rollout(u, 4).reshape(3, 5, 30), torch.stack(states, 1))
    (expected,) = torch.autograd.grad(torch.stack(states).square().sum(), values)
    torch.testing.assert_close(values.grad, expected)


def solved(matrix, b):
    return torch.linalg.solve(matrix, b.reshape(-1, 30).mT).mT


def dense(a, values):
    """The matrix of `a` with these values, recorded by autograd."""
    if isinstance(a, operators.Matrix):
        crow, col = a.tensors[0], a.tensors[1]
        row = torch.repeat_interleave(torch.arange(30), crow.diff())
        return torch.zeros(30, 30, dtype=values.dtype).index_put((row, col), values)
    units = torch.eye(30, dtype=values.dtype).reshape(30, 1, *SHAPE)
    shifted = [units.roll((-dy, -dx), (-2, -1)) for dy, dx in FIVE]
    return sum(values[:, k : k + 1] * v for k, v in enumerate(shifted)).reshape(30, 30).mT


@pytest.mark.parametrize("make", [stencil, csr])
@pytest.mark.parametrize("symmetric", [True, False], ids=["symmetric", "not symmetric"])
def test_kept_factors_change_no_bit(make, symmetric):
    """Alone or in a batch, with new factors or kept ones."""
    a = make(symmetric)
    b = rhs(a, 3)
    _C.clear_factorisations()
    u = prdp.linear_solve(a, b, prdp.Direct())[0]
    assert torch.equal(prdp.linear_solve(a, b, prdp.Direct())[0], u)
    for s in range(3):
        _C.clear_factorisations()
        assert torch.equal(prdp.linear_solve(a, b[s : s + 1], prdp.Direct())[0][0], u[s])


@pytest.mark.parametrize("make", [stencil, csr])
@pytest.mark.parametrize("symmetric", [True, False], ids=["symmetric", "not symmetric"])
def test_a_changed_matrix_is_factorised_anew(make, symmetric):
    """In place too, where torch counts no version."""
    a = make(symmetric)
    b = rhs(a, 2)
    u = prdp.linear_solve(a, b, prdp.Direct())[0]
    a.tensors[-1].data.mul_(2.0)
    torch.testing.assert_close(prdp.linear_solve(a, b, prdp.Direct())[0], u / 2)
    with torch.no_grad():
        a.tensors[-1].copy_(make(symmetric, seed=3).tensors[-1])
    expected = solved(dense(a, a.tensors[-1]), b)
    torch.testing.assert_close(prdp.linear_solve(a, b, prdp.Direct())[0].reshape(2, 30), expected)


def test_those_of_a_batch_of_matrices_are_kept_for_its_adjoint_solves():
    several = [stencil(True, seed) for seed in range(3)]
    a = operators.Stencil(torch.cat([one.tensors[0] for one in several]), FIVE, "periodic")
    b = rhs(a, 3).requires_grad_()

    def update():
        u, _ = prdp.linear_solve(a, b, prdp.Direct())
        u.sum().backward()

    assert factorisations(lambda: [update(), update()]) == 3


def update_of(n, matrices):
    """Updates of a training, each of which solves with these matrices of n² cells and goes back through them."""
    b, multigrid = torch.randn(1, 1, n, n).requires_grad_(), prdp.CG(0, preconditioner="multigrid")
    c = torch.tensor([4.3, -1, -1, -1, -1]).view(1, 5, 1, 1).expand(1, 5, n, n).contiguous()

    def update(first):
        made = _C.count_factorisations()
        a = [operators.Stencil((1 + 1e-3 * (first + k)) * c, FIVE, "zero") for k in range(matrices)]
        u = [prdp.linear_solve(one, b, multigrid, on_failure="return")[0] for one in a]
        torch.autograd.grad(sum(u).sum(), b)
        return _C.count_factorisations() - made

    return update


def test_matrices_that_are_never_used_again_take_little_memory():
    """A new one in each update: it is there for the adjoint solve, and soon gone."""
    update = update_of(512, 1)
    _C.clear_factorisations()
    kept = []
    for first in range(28):
        assert update(first) == 1
        kept.append(_C.bytes_of_factorisations())
    assert kept[3] == 4 * kept[0] and max(kept) <= (64 << 20) + kept[0] < 28 * kept[0] / 2


def test_matrices_that_are_used_again_late_stay():
    """More of them in an update than are kept at first: from the second on each is made once."""
    update = update_of(512, 16)
    _C.clear_factorisations()
    assert update(0) > 16
    assert [update(16), update(16)] == [16, 0]
    assert _C.bytes_of_factorisations() <= 512 << 20


SMALL = """
import torch, prdp_torch as prdp
from prdp_torch import _C
offsets = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
resident = lambda: int(open("/proc/self/statm").read().split()[1]) * 4096
b = torch.ones(1, 1, 8, 8, dtype=torch.float64)
for solves in (20, 400):
    before, kept = resident(), _C.bytes_of_factorisations()
    for _ in range(solves):
        c = torch.rand(1, 5, 8, 8, dtype=torch.float64)
        c[:, 0] += 5
        prdp.linear_solve(prdp.operators.Stencil(c, offsets), b, prdp.Direct())
print((resident() - before) / (_C.bytes_of_factorisations() - kept))
"""


def test_small_factors_are_counted_with_what_lies_beside_them():
    done = subprocess.run([sys.executable, "-c", SMALL], capture_output=True, text=True, check=True, timeout=120)
    assert 0.3 < float(done.stdout) < 1.6  # it was four


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_symmetric_matrices_of_either_sign_and_indefinite_ones(sign):
    """Cholesky's factors serve definite matrices; an indefinite one needs pivoting."""
    a = stencil(True)
    for shift in (0.0, 4.0):  # within the spectrum
        c = sign * a.tensors[0].clone()
        c[:, 0] -= sign * shift
        moved = operators.Stencil(c, FIVE, "periodic")
        assert torch.equal(moved.dense(), moved.dense().mT)
        values = torch.linalg.eigvalsh(moved.dense()) * sign
        assert (values > 0).all() if shift == 0 else (values < 0).any() and (values > 0).any()
        b = rhs(moved, 2)
        expected = solved(moved.dense(), b)
        torch.testing.assert_close(prdp.linear_solve(moved, b, prdp.Direct())[0].reshape(2, 30), expected)


def laplacian(dtype, scale=1.0, nullspace="constant"):
    """Of a periodic grid, its equations times `scale`, a number or a field: singular."""
    c = torch.full((5, *SHAPE), -1.0, dtype=dtype)
    c[1] = -2.0
    c[0] = -c[1:].sum(0)
    left = (torch.ones(1, *SHAPE, dtype=dtype) / scale) if torch.is_tensor(scale) else None
    right = torch.ones(1, *SHAPE, dtype=dtype) if torch.is_tensor(scale) else nullspace
    return operators.Stencil(c[None] * scale, FIVE, "periodic", nullspace=right, left_nullspace=left)


def solved_twice(a, b):
    """u and the gradient of b, the second time from what the first has kept, and those of a pseudo-inverse."""
    found = []
    for _ in range(2):
        v = b.clone().requires_grad_()
        u, info = prdp.linear_solve(a, v, prdp.Direct())
        assert set(statuses(info)) == {"CONVERGED"}
        found.append((u.detach(), torch.autograd.grad(u, v, b.flip(0))[0]))
    inverse = torch.linalg.pinv(a.dense().double(), rtol=1e-5)
    rows = (b.double().reshape(-1, 30), inverse.mT), (b.flip(0).double().reshape(-1, 30), inverse)
    return *found, [(r @ x).to(b.dtype).reshape(b.shape) for r, x in rows]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_kept_kernel_serves_its_own_operator_alone(dtype):
    """Not one of other values, null spaces, channels or dtype, and not the transpose."""
    torch.manual_seed(2)
    scale = torch.rand(SHAPE, dtype=dtype) + 0.5
    ones = torch.ones(1, *SHAPE, dtype=dtype)
    several = [laplacian(dtype), laplacian(dtype, 3.0), laplacian(dtype, nullspace=ones), laplacian(dtype, scale)]
    for a in several:
        for channels in (1, 2):
            b = a.apply(torch.randn(3, channels, *SHAPE, dtype=dtype))
            first, second, expected = solved_twice(a, b)
            assert all(torch.equal(x, y) for x, y in zip(first, second, strict=True))
            torch.testing.assert_close(list(first), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("boundary", ["zero", "periodic"])
def test_a_kept_kernel_of_diffusion_sees_its_values_change(boundary):
    torch.manual_seed(2)
    kappa = torch.rand(1, *SHAPE, dtype=torch.float64) + 0.5
    a = operators.Diffusion(kappa, boundary=boundary, shift=1.0)
    b = torch.randn(2, 1, *SHAPE, dtype=torch.float64)
    for _ in range(3):
        u, _ = prdp.linear_solve(a, b, prdp.Direct())
        torch.testing.assert_close(u.reshape(2, 30), solved(a.dense(), b))
        kappa.data.mul_(1.7)


@pytest.mark.parametrize(("asymmetry", "by_cholesky"), [(0.0, True), (1e-16, True), (1e-9, False)])
def test_rounding_does_not_hide_that_a_matrix_is_symmetric(asymmetry, by_cholesky):
    """Sums over elements come out different in the two triangles; Cholesky's method stores half of what LU does."""
    n = 12
    exact = torch.from_numpy(dense_heat((n, n)))
    rounding = torch.triu((exact != 0).double(), 1) * asymmetry * exact.diagonal().max()
    matrix = (exact + rounding).to_sparse_csr()
    b = torch.ones(1, n * n, dtype=torch.float64)
    _C.clear_factorisations()
    u, info = prdp.linear_solve(matrix, b, prdp.Direct())
    assert info.solved.all()
    torch.testing.assert_close(u[0], torch.linalg.solve(matrix.to_dense(), b[0]), rtol=1e-11, atol=0)
    stored = _C.bytes_of_factorisations()
    _C.clear_factorisations()
    prdp.linear_solve(exact.to_sparse_csr(), b, prdp.Direct())
    assert (stored == _C.bytes_of_factorisations()) == by_cholesky
