"""Right-hand sides and cotangents of singular operators that consist of the least numbers of their dtype: what rounding
leaves of them outside the range is no failure, and u is right to the last bit."""

import numpy as np
import pytest
import torch
from helpers import statuses
from hypothesis import given, settings
from hypothesis import strategies as st
from test_null_space import graph_laplacian, periodic_stencil
from test_other_devices import solve_there
from test_unnamed_null_space import METHODS, insulated

import prdp_torch as prdp
from prdp_torch import _C, operators

F32, F64 = torch.float32, torch.float64
LEAST = {F32: -149, F64: -1074}
NORMAL = {F32: -126, F64: -1022}


def times(v, exponent):
    """2^exponent v, by two powers that both are normal numbers."""
    half = exponent // 2
    return v * 2.0**half * 2.0 ** (exponent - half)


def laplacian(v):
    return 2 * v - v.roll(1, -1) - v.roll(-1, -1)


KINDS = {
    "stencil": lambda dtype: (periodic_stencil(dtype=dtype), (2, 5, 6)),
    "diffusion": lambda dtype: (operators.Diffusion(torch.ones(1, 5, 6, dtype=dtype), boundary="flux"), (1, 5, 6)),
    "matrix": lambda dtype: (operators.Matrix(graph_laplacian(dtype), nullspace="constant"), (7,)),
    "csr": lambda dtype: (operators.Matrix(graph_laplacian(dtype).to_sparse_csr(), nullspace="constant"), (7,)),
    "function": lambda dtype: (operators.Function(laplacian, symmetric=True, nullspace="constant"), (1, 9)),
}
SOLVERS = {
    "cg": prdp.CG(200, 1e-6),
    "steepest descent": prdp.SteepestDescent(5000, 1e-6),
    "gmres": prdp.GMRES(40, restart=30, rtol=1e-6),
    "bicgstab": prdp.BiCGStab(200, 1e-6),
    "direct": prdp.Direct(),
}
GRIDS = {
    "cg, multigrid": prdp.CG(60, 1e-6, preconditioner="multigrid"),
    "multigrid": prdp.Multigrid(60, 1e-6),
}
CASES = [(kind, name) for kind in KINDS for name in SOLVERS] + [
    (k, name) for k in ("stencil", "diffusion") for name in GRIDS
]


def pseudo_inverse(a, shape):
    n = int(np.prod(shape))
    tensors = [t.double() if t.is_floating_point() else t for t in a.tensors]
    units = torch.eye(n, dtype=F64).reshape(n, *shape)
    columns = torch.ops.prdp.apply(units, tensors, a.kind, a.shape, a.parameters, False)
    return np.linalg.pinv(columns.reshape(n, n).numpy().T, rcond=1e-5)  # in float32 the rows do not sum to zero exactly


def consistent(shape, dtype, exponent, seed=0):
    """Noise without a mean in any channel, of the order of 2^exponent, as the dtype holds it."""
    b = torch.randn(2, *shape, dtype=F64, generator=torch.Generator().manual_seed(seed))
    axes = tuple(range(2 if len(shape) > 1 else 1, b.dim()))
    return times((b - b.mean(axes, keepdim=True)).to(dtype), exponent)


def assert_right_to_the_last_bit(found, given, inverse, exponent):
    """Against the pseudo-inverse in numbers of order one, within one of the least numbers and the tolerance."""
    scaled = [times(t.detach().double(), -exponent).flatten(1).numpy() for t in (given, found)]
    expected = scaled[0] @ inverse.T
    least = 2.0 ** (LEAST[found.dtype] - exponent)
    assert np.abs(scaled[1] - expected).max() <= least + 1e-4 * np.abs(expected).max()


def is_no_failure(info):
    return set(statuses(info)) <= {"CONVERGED", "CONVERGED_BREAKDOWN", "STAGNATED"}


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("kind, name", CASES)
def test_u_and_the_gradient_are_those_of_the_pseudo_inverse(kind, name, dtype):
    a, shape = KINDS[kind](dtype)
    inverse, solver = pseudo_inverse(a, shape), {**SOLVERS, **GRIDS}[name]
    for below in (4, 12, 20):
        exponent = NORMAL[dtype] - below
        b = consistent(shape, dtype, exponent).requires_grad_()
        u, info = prdp.linear_solve(a, b, solver)
        assert is_no_failure(info)
        assert_right_to_the_last_bit(u, b, inverse, exponent)
        cotangent = times(torch.randn(2, *shape, dtype=dtype, generator=torch.Generator().manual_seed(1)), exponent)
        (b_bar,) = torch.autograd.grad(u, b, cotangent)
        assert is_no_failure(info.adjoint)
        assert_right_to_the_last_bit(b_bar, cotangent, inverse.T, exponent)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("kind, name", CASES)
def test_where_all_of_b_is_its_rounding_u_is_zero(kind, name, dtype):
    a, shape = KINDS[kind](dtype)
    b = torch.full((2, *shape), 2.0 ** LEAST[dtype], dtype=dtype)
    u, info = prdp.linear_solve(a, b, {**SOLVERS, **GRIDS}[name])
    assert is_no_failure(info) and not u.any()


@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_b_of_tiny_numbers_that_does_lie_outside_the_range_is_told(dtype):
    for kind in KINDS:
        a, shape = KINDS[kind](dtype)
        b = consistent(shape, dtype, NORMAL[dtype] - 4) + 2.0 ** (NORMAL[dtype] - 6)
        assert statuses(prdp.linear_solve(a, b, SOLVERS["gmres"], on_failure="return")[1]) == ["INCONSISTENT"] * 2


@settings(max_examples=60, deadline=None)
@given(
    kind=st.sampled_from(list(KINDS)), name=st.sampled_from(list(SOLVERS)), single=st.booleans(),
    above=st.integers(0, 30), seed=st.integers(0, 10**6),
)  # fmt: skip
def test_down_to_the_least_number_nothing_fails(kind, name, single, above, seed):
    dtype = F32 if single else F64
    a, shape = KINDS[kind](dtype)
    exponent = LEAST[dtype] + above
    b = consistent(shape, dtype, exponent, seed)
    u, info = prdp.linear_solve(a, b, SOLVERS[name])
    assert is_no_failure(info)
    assert_right_to_the_last_bit(u, b, pseudo_inverse(a, shape), exponent)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("method", ["cg", "bicgstab", "gmres", "steepest_descent"])
def test_plain_tensors_say_the_same(method, dtype):
    for kind in ("stencil", "matrix"):
        a, shape = KINDS[kind](dtype)
        spec = (a.tensors, a.kind, a.shape, a.parameters, False, method)
        for exponent in (NORMAL[dtype] - 12, LEAST[dtype]):
            b = consistent(shape, dtype, exponent)
            b[0] = 2.0 ** LEAST[dtype]
            u, info = _C.solve_with_tensors(b, *spec, 2000, 1e-6, 20)
            assert (info[2] >= -2).all() and info[0][0] == 0 and not u[0].any() and info[4][0] == 1
            assert_right_to_the_last_bit(u[1:], b[1:], pseudo_inverse(a, shape), exponent)


@pytest.mark.parametrize("method", ["cg", "steepest_descent"])
def test_a_device_that_is_not_looked_at_says_the_same(method):
    for dtype in (F32, F64):
        a = periodic_stencil((7, 9), dtype=dtype)
        b = consistent((1, 7, 9), dtype, NORMAL[dtype] - 12)
        b[0] = 2.0 ** LEAST[dtype]
        settings = (method, 60, 0.0, 4, None, "")
        u, info = _C.solve_with_tensors(b, a.tensors, a.kind, a.shape, a.parameters, False, *settings)
        v, report, _ = solve_there(b, a, *settings)
        assert torch.equal(u, v) and all(torch.equal(x, y) for x, y in zip(info, report, strict=True))
        assert info[2][0] == int(prdp.SolveStatus.STAGNATED) and info[4][0] == 1 and (info[2] >= -2).all()


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("method", [m for m in METHODS if m != "direct"])  # which takes no singular matrix at any scale
def test_where_nobody_named_the_null_space_nothing_fails_either(method, dtype):
    """The mean of b is its rounding, and what is left of the residual is that mean. With nine bits, float32's at the
    last exponent, CG may also stop far above rtol, which depends on the order of sums."""
    n = 16
    a = insulated(n, dtype)
    for seed in range(3 if dtype == F32 and method.startswith("cg") else 4):
        exponent = NORMAL[dtype] - 4 * seed - 2
        b = consistent((1, n, n), dtype, exponent, seed)
        u, info = prdp.linear_solve(a, b, METHODS[method](300, 1e-6))
        left = times((b.double() - insulated(n, F64).apply(u.double())) if dtype == F32 else b - a.apply(u), -exponent)
        least = 2.0 ** (LEAST[dtype] - exponent)
        assert not info.failed.any()
        if method not in ("jacobi", "steepest descent"):  # which are not done then
            assert left.abs().max() <= 64 * least + 1e-4


def test_a_direct_solve_leaves_numbers_below_the_normal_ones_to_torch():
    """Its factors flush them; nobody else asked for that."""
    a = operators.Diffusion(torch.ones(1, 16, 16, dtype=torch.float64), shift=torch.rand(1, 16, 16).double())
    prdp.linear_solve(a, torch.ones(1, 1, 16, 16, dtype=torch.float64), prdp.Direct())
    least = torch.full((64,), 2.0, dtype=torch.float64) * 2.5e-310
    assert (least > 0).all() and (least / 2 > 0).all()
