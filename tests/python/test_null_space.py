"""Singular operators of one's own whose null space is named."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import field, random, statuses
from hypothesis import given, settings
from hypothesis import strategies as st

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def periodic_stencil(shape=(5, 6), nullspace="constant", dtype=F64, wind=0.0):
    """-∇·(κ ∇u) on a periodic grid, whose rows and columns sum to zero; with `wind`, not symmetric."""
    kappa = 0.5 + torch.rand(shape, dtype=dtype, generator=torch.Generator().manual_seed(1))
    dim, fields, offsets = len(shape), [], []
    centre = torch.zeros(shape, dtype=dtype)
    for axis in range(dim):
        for step in (-1, 1):
            face = (kappa + kappa.roll(-step, axis)) / 2 - step * wind * (shape[axis] > 2)
            offsets.append(tuple(step if d == axis else 0 for d in range(dim)))
            fields.append(-face)
            centre += face
    stencil = torch.stack([centre, *fields])[None]
    return operators.Stencil(stencil, [(0,) * dim, *offsets], boundary="periodic", nullspace=nullspace)


def graph_laplacian(dtype=F64):
    a = torch.rand(7, 7, dtype=dtype, generator=torch.Generator().manual_seed(2))
    a = a + a.T
    return torch.diag(a.sum(1)) - a


SYMMETRIC = {
    "stencil": lambda: (periodic_stencil(), (3, 2, 5, 6)),
    "matrix": lambda: (operators.Matrix(graph_laplacian(), nullspace="constant"), (3, 7)),
    "csr": lambda: (operators.Matrix(graph_laplacian().to_sparse_csr(), nullspace=torch.ones(1, 7, dtype=F64)), (3, 7)),
    "function": lambda: (
        operators.Function(lambda v: 2 * v - v.roll(1, -1) - v.roll(-1, -1), symmetric=True, nullspace="constant"),
        (3, 1, 9),
    ),
}
SOLVERS = {
    "cg": prdp.CG(200, rtol=1e-11),
    "sd": prdp.SteepestDescent(20000, rtol=1e-10),
    "gmres": prdp.GMRES(40, rtol=1e-11, restart=40),
    "bicgstab": prdp.BiCGStab(200, rtol=1e-10),
    "direct": prdp.Direct(),
}


def dense_of(a, shape):
    """A as a matrix on one sample, from products with unit vectors."""
    n = int(np.prod(shape[1:]))
    units = torch.eye(n, dtype=F64).reshape(n, *shape[1:])
    return a.apply(units).reshape(n, n).T.numpy()


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("kind", SYMMETRIC)
def test_solution_and_gradient_are_those_of_the_pseudo_inverse(kind, solver):
    a, shape = SYMMETRIC[kind]()
    generator = torch.Generator().manual_seed(3)
    b, cotangent = (torch.randn(shape, dtype=F64, generator=generator) for _ in range(2))
    b = a_range(a, b, shape).requires_grad_()
    u, info = prdp.linear_solve(a, b, SOLVERS[solver])
    assert (info.status > 0).all()
    u.backward(cotangent)  # has a mean, which no u changes
    inverse = np.linalg.pinv(dense_of(a, shape), rcond=1e-10)
    for found, of, m in ((u, b, inverse), (b.grad, cotangent, inverse.T)):
        expected = of.detach().flatten(1).numpy() @ m.T
        np.testing.assert_allclose(found.detach().flatten(1), expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def a_range(a, b, shape):
    m = dense_of(a, shape)
    return torch.tensor(b.flatten(1).numpy() @ (m @ np.linalg.pinv(m, rcond=1e-10)).T).reshape(shape)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("kind", SYMMETRIC)
def test_a_right_hand_side_outside_the_range_is_told(kind, solver):
    a, shape = SYMMETRIC[kind]()
    b = torch.randn(shape, dtype=F64, generator=torch.Generator().manual_seed(4))
    b[0] = a_range(a, b, shape)[0]
    u, info = prdp.linear_solve(a, b, SOLVERS[solver], on_failure="return")
    assert statuses(info)[1:] == ["INCONSISTENT"] * 2 and info.status[0] > 0
    inverse = np.linalg.pinv(dense_of(a, shape), rcond=1e-10)
    expected = b.flatten(1).numpy() @ inverse.T
    np.testing.assert_allclose(u.flatten(1), expected, rtol=0, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("rtol", [0.0, 1e-6])
@pytest.mark.parametrize("solver", [s for s in SOLVERS if s != "direct"])
def test_nothing_is_iterated_where_all_of_b_lies_outside_the_range(solver, rtol):
    """The rounding that is left of b is no right-hand side; the other sample is solved as alone."""
    a, shape = SYMMETRIC["function"]()
    b = field(shape[2:], 2)
    b -= b.mean(-1, keepdim=True)
    b[0] = 1 / 3
    short = replace(SOLVERS[solver], max_iter=3, rtol=rtol)
    u, info = prdp.linear_solve(a, b, short, on_failure="return")
    alone, _ = prdp.linear_solve(a, b[1:], short, on_failure="return")
    assert statuses(info)[0] == "INCONSISTENT" and info.residual[0] == 1 and info.operator_applications[0] == 0
    assert not u[0].any() and torch.equal(u[1], alone[0])


def test_left_and_right_null_spaces_differ():
    generator = torch.Generator().manual_seed(5)
    q, p = (torch.linalg.qr(torch.randn(8, 8, dtype=F64, generator=generator))[0] for _ in range(2))
    values = torch.tensor([3.0, 2.0, 1.5, 1.2, 1.0, 0.8, 0.0, 0.0], dtype=F64)
    m = q @ torch.diag(values) @ p.T
    a = operators.Matrix(m, nullspace=p[:, 6:].T, left_nullspace=q[:, 6:].T)
    b = (m @ torch.randn(8, dtype=F64, generator=generator))[None].requires_grad_()
    inverse = torch.linalg.pinv(m, rtol=1e-10)
    for solver in (prdp.GMRES(10, rtol=1e-11, restart=8), prdp.Direct()):
        u, _ = prdp.linear_solve(a, b, solver)
        (found,) = torch.autograd.grad(u.square().sum(), b)
        torch.testing.assert_close(u, b @ inverse.T, rtol=1e-8, atol=1e-8)
        torch.testing.assert_close(found, 2 * u @ inverse, rtol=1e-8, atol=1e-8)
    with pytest.raises(ValueError, match=r"left_nullspace is not in the null space of Aᵀ.*give left_nullspace="):
        prdp.linear_solve(operators.Matrix(m, nullspace=p[:, 6:].T), b, prdp.Direct())


GRADIENT_SOLVERS = [
    prdp.CG(60, rtol=1e-12),
    prdp.CG(30, rtol=1e-12, preconditioner="multigrid"),
    prdp.GMRES(30, rtol=1e-12, preconditioner="multigrid"),
    prdp.Direct(),
]


@pytest.mark.parametrize("solver", GRADIENT_SOLVERS, ids=repr)
def test_gradients_for_coefficients(solver):
    shape = (4, 5)

    def loss(kappa, b):
        faces = [(kappa + kappa.roll(-step, axis)) / 2 for axis in (0, 1) for step in (-1, 1)]
        stencil = torch.stack([sum(faces), *(-face for face in faces)])[None]
        offsets = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
        a = operators.Stencil(stencil, offsets, boundary="periodic", nullspace="constant")
        return prdp.linear_solve(a, b - b.mean((-2, -1), keepdim=True), solver)[0]

    kappa = 0.5 + torch.rand(shape, dtype=F64, generator=torch.Generator().manual_seed(1))
    b = field(shape, channels=1, batch=1)
    assert torch.autograd.gradcheck(loss, (kappa.requires_grad_(), b.requires_grad_()))


def test_multigrid_takes_the_iterations_of_a_regular_operator_at_a_tight_tolerance():
    a = periodic_stencil((255, 255))
    b = field((255, 255), channels=1, batch=1)
    _, info = prdp.linear_solve(a, b - b.mean(), prdp.CG(40, rtol=1e-10, preconditioner="multigrid"))
    assert info.solved.all() and info.iterations.max() <= 10


def test_a_vector_that_is_none_is_refused():
    wrong = torch.linspace(0, 1, 30, dtype=F64).reshape(1, 5, 6)
    with pytest.raises(ValueError, match=r"Stencil: vector 0 of nullspace is not in the null space of A"):
        prdp.linear_solve(periodic_stencil(nullspace=wrong), field((5, 6)), prdp.CG(3))
    regular = operators.Stencil(3 * torch.ones(1, 1, 5, 6, dtype=F64), [(0, 0)], nullspace="constant")
    with pytest.raises(ValueError, match=r"Stencil: vector 0 of nullspace is not in the null space of A"):
        prdp.linear_solve(regular, field((5, 6)), prdp.CG(3))


def pinv_of(a, shape):
    return torch.from_numpy(np.linalg.pinv(dense_of(a, shape), rcond=1e-12))


@settings(max_examples=40, deadline=None)
@given(
    stretch=st.floats(1, 1e3), turned=st.booleans(), seed=st.integers(0, 10**6),
    boundary=st.sampled_from(["flux", "periodic", ("flux", "periodic")]),
)  # fmt: skip
def test_diffusion_takes_its_own_null_space_however_stretched_its_cells_are(stretch, turned, boundary, seed):
    shape, length = (6, 7), (1.0, stretch * 7 / 6)
    if turned:
        length = length[::-1]
    kappa = torch.exp(torch.randn(1, *shape, dtype=F64, generator=torch.Generator().manual_seed(seed)))
    a = operators.Diffusion(kappa, boundary=boundary, length=length)
    b = field(shape, channels=1, seed=seed)
    b = b - b.mean((-1, -2), keepdim=True)
    expected = (b.flatten(1) @ pinv_of(a, (1, 1, *shape)).T).view_as(b)
    u, _ = prdp.linear_solve(a, b, prdp.Direct())
    torch.testing.assert_close(u, expected, rtol=0, atol=1e-8 * expected.abs().max().item())
    in_single = operators.Diffusion(kappa.float(), boundary=boundary, length=length)
    prdp.linear_solve(in_single, b.float(), prdp.CG(3, rtol=0))  # is not refused


def wide_laplacian(v):
    return 2 * v - v.roll(2, -1) - v.roll(-2, -1)


@pytest.mark.parametrize("kind", ["stencil", "function"])
def test_a_checkerboard_is_a_null_vector_of_differences_over_two_cells(kind):
    n = 12
    basis = torch.stack([torch.ones(n, dtype=F64), 1.0 - 2.0 * (torch.arange(n) % 2).to(F64)])
    if kind == "stencil":
        coefficients = torch.tensor([2.0, -1.0, -1.0], dtype=F64).reshape(1, 3, 1).expand(1, 3, n).contiguous()
        a = operators.Stencil(coefficients, [(0,), (-2,), (2,)], "periodic", nullspace=basis)
    else:
        a = operators.Function(wide_laplacian, symmetric=True, nullspace=basis)
    b = wide_laplacian(field((n,), channels=1))
    u, info = prdp.linear_solve(a, b, prdp.CG(60, rtol=1e-11))
    assert (info.status > 0).all()
    torch.testing.assert_close(u.flatten(1), b.flatten(1) @ pinv_of(a, (1, 1, n)).T, rtol=1e-8, atol=1e-8)


def test_no_sample_is_judged_by_the_size_of_another():
    """Of the first, the constant is no null vector; the second is 1e12 times as large."""
    c = torch.tensor([2.0, -1.0, -1.0], dtype=F64).reshape(1, 3, 1).expand(2, 3, 8).clone()
    c[1] *= 1e12
    c[0, 0] += 1e-3
    a = operators.Stencil(c, [(0,), (-1,), (1,)], "periodic", nullspace="constant")
    with pytest.raises(ValueError, match=r"vector 0 of nullspace is not in the null space of A.*entries of 0\.001"):
        prdp.linear_solve(a, field((8,)), prdp.CG(3))


def test_arguments_are_checked():
    m = graph_laplacian()
    b = torch.ones(1, 7, dtype=F64)
    with pytest.raises(TypeError, match=r"Matrix: nullspace must be None, 'constant' or a tensor \(k, \*shape\)"):
        operators.Matrix(m, nullspace="linear")
    with pytest.raises(ValueError, match="left_nullspace= stands beside nullspace="):
        operators.Matrix(m, left_nullspace="constant")
    with pytest.raises(ValueError, match=r"Matrix: a null space must have shape \(k, \*shape\)"):
        prdp.linear_solve(operators.Matrix(m, nullspace=torch.ones(1, 6, dtype=F64)), b, prdp.CG(3))
    with pytest.raises(ValueError, match="must hold as many vectors, got 2 and 1"):
        operators.Matrix(m, nullspace=torch.rand(2, 7, dtype=F64), left_nullspace="constant")
    twice = torch.ones(2, 7, dtype=F64)
    with pytest.raises(ValueError, match="vector 1 of a null space is zero, not finite, or depends on those before it"):
        prdp.linear_solve(operators.Matrix(m, nullspace=twice), b - 1, prdp.CG(3))


def test_check_operator_finds_a_constant_that_nobody_named():
    example = torch.zeros(2, 1, 5, 6, dtype=F64)
    assert prdp.check_operator(periodic_stencil(), example)
    with pytest.raises(ValueError, match="A maps the constant to zero, so it is singular: give nullspace='constant'"):
        prdp.check_operator(periodic_stencil(nullspace=None), example)
    with pytest.raises(ValueError, match="check_operator: Matrix: vector 0 of nullspace is not in the null space of A"):
        prdp.check_operator(
            operators.Matrix(torch.eye(4, dtype=F64), nullspace="constant"), torch.ones(2, 4, dtype=F64)
        )


@pytest.mark.parametrize("preconditioner", [None, "diagonal", "multigrid"])
@pytest.mark.parametrize("boundary", ["periodic", "zero"])
def test_in_float32_more_iterations_than_the_dtype_needs_do_no_harm(boundary, preconditioner):
    """Coefficients of a 2π box do not sum to zero exactly, and products leave rounding along the constant."""
    n, h = 64, 2 * torch.pi / 64
    sides = [torch.ones(n, n) for _ in range(4)]
    if boundary == "zero":  # no flux
        for side, axis, end in zip(sides, (1, 1, 0, 0), (0, -1, 0, -1), strict=True):
            side.select(axis, end).zero_()
    coefficients = torch.stack([sum(sides), *(-side for side in sides)])[None] / h**2
    offsets = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
    a = operators.Stencil(coefficients, offsets, boundary, nullspace="constant")
    b = torch.randn(1, 1, n, n, dtype=F64, generator=torch.Generator().manual_seed(0))
    b = (b - b.mean()).float()
    for k in (300, 600):
        _, info = prdp.linear_solve(a, b, prdp.CG(k, rtol=0.0, preconditioner=preconditioner))
        assert info.residual.max() < 5e-5
    _, info = prdp.linear_solve(a, b, prdp.CG(600, rtol=1e-8, preconditioner=preconditioner))
    assert statuses(info) == ["STAGNATED"] and 0 < info.residual.max() < 5e-5


def test_functions_stay_at_the_floor_as_stencils_do():
    def matvec(v):
        return 4 * v - sum(v.roll(step, axis) for step in (-1, 1) for axis in (-1, -2))

    b = torch.randn(2, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    b = b - b.mean((-1, -2), keepdim=True)
    a = operators.Function(matvec, symmetric=True, nullspace="constant")
    for k in (200, 600):
        u, info = prdp.linear_solve(a, b, prdp.CG(k, rtol=0.0))
        left = (b - matvec(u)).double()
        assert statuses(info) == ["MAX_ITER"] * 2
        assert (left.flatten(1).norm(dim=1) < 5e-5 * b.double().flatten(1).norm(dim=1)).all()


@pytest.mark.filterwarnings("ignore:`torch.jit.script")
@pytest.mark.parametrize("on_failure", ["raise", "zero_grad"])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("kind", ["stencil", "matrix", "function", "diffusion", "left and right"])
def test_forward_mode_takes_a_b_out_of_the_range_as_reverse_mode_does(kind, backward, on_failure):
    """The entries of b are moved one by one, out of the range of A; what is outside does not reach u."""
    if kind == "diffusion":
        kappa = torch.exp(torch.randn(1, 4, 5, dtype=F64, generator=torch.Generator().manual_seed(1)))
        a, shape = operators.Diffusion(kappa, boundary="flux"), (1, 1, 4, 5)
    elif kind == "left and right":
        q, p = (torch.linalg.qr(random(8, 8, seed=seed))[0] for seed in (1, 2))
        m = q @ torch.diag(torch.tensor([3.0, 2.0, 1.5, 1.2, 1.0, 0.8, 0.0, 0.0], dtype=F64)) @ p.T
        a, shape = operators.Matrix(m, nullspace=p[:, 6:].T, left_nullspace=q[:, 6:].T), (1, 8)
    elif kind == "stencil":
        a, shape = periodic_stencil((3, 4)), (1, 1, 3, 4)
    else:
        a, shape = SYMMETRIC[kind]()
        shape = (1, *shape[1:])
    solver = prdp.GMRES(4, rtol=1e-12, restart=30) if kind == "left and right" else prdp.CG(60, rtol=1e-12)
    b = a_range(a, random(*shape), shape)

    def solution(b):
        return prdp.linear_solve(a, b, solver, backward=backward, on_failure=on_failure)[0]

    n = b.numel()
    forward = torch.func.jacfwd(solution)(b).reshape(n, n)
    reverse = torch.func.jacrev(solution)(b).reshape(n, n)
    rounding = 1e-8 * reverse.abs().max().item()
    torch.testing.assert_close(forward, reverse, rtol=0, atol=rounding)
    if backward == "implicit":
        torch.testing.assert_close(forward, pinv_of(a, shape), rtol=0, atol=rounding)


@pytest.mark.filterwarnings("ignore:`torch.jit.script")
def test_forward_mode_takes_the_mean_off_a_pressure():
    winds = 0.1 * field((4, 5), 1, 1, channels=3)
    a, b = operators.NavierStokes(winds, 1e-2, 0.1), random(1, 3, 4, 5)
    b[:, 2] -= b[:, 2].mean()

    def solution(b):
        return prdp.linear_solve(a, b, prdp.GMRES(3, rtol=1e-12, restart=60))[0]

    tangent = torch.func.jvp(solution, (b,), (torch.ones_like(b),))[1]
    expected = torch.ones(60, dtype=F64) @ pinv_of(a, (1, 3, 4, 5)).T
    torch.testing.assert_close(tangent.flatten(), expected, rtol=1e-7, atol=1e-7)


def test_an_operator_that_knows_its_null_space_takes_none():
    v, constant = torch.ones(1, 1, 4), torch.empty(0)
    with pytest.raises(ValueError, match="operator: Poisson takes no null spaces"):
        torch.ops.prdp.apply(v, [constant, constant], "singular_poisson", [4], [], False)
    with pytest.raises(ValueError, match="unknown kind 'none'; allowed: heat, "):
        torch.ops.prdp.apply(v, [constant, constant], "singular_none", [4], [], False)
