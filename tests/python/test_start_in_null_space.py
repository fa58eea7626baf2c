"""Starts that A maps to zero, or to rounding: the solve starts from zero, and ends as it does from there."""

from dataclasses import replace

import pytest
import torch
from helpers import field, random
from hypothesis import given, settings
from hypothesis import strategies as st
from test_null_space import graph_laplacian, periodic_stencil
from test_unnamed_null_space import insulated

import prdp_torch as prdp
from prdp_torch import _C, operators

F32, F64 = torch.float32, torch.float64


def diffusion(shape, seed, dtype=F32):
    kappa = torch.exp(torch.randn(1, *shape, dtype=F64, generator=torch.Generator().manual_seed(seed)))
    return operators.Diffusion(kappa.to(dtype), boundary="flux")


def mean_free(*shape, dtype, seed=0):
    b = random(*shape, seed=seed)
    return (b - b.mean(tuple(range(1, b.dim())), keepdim=True)).to(dtype)


def laplacian(v):
    return 2 * v - v.roll(1, -1) - v.roll(-1, -1)


def rough(dtype):
    """-∂(κ ∂v) on a ring, by sums that leave rounding of a constant."""
    face = (0.5 + torch.rand(40, dtype=F64, generator=torch.Generator().manual_seed(7))).to(dtype)
    centre = face + face.roll(1, -1)
    return lambda v: centre * v - face * v.roll(-1, -1) - face.roll(1, -1) * v.roll(1, -1)


KINDS = {
    "diffusion": lambda dtype: (diffusion((12, 14), 1, dtype), (1, 12, 14)),
    "stencil": lambda dtype: (periodic_stencil((12, 14), dtype=dtype), (1, 12, 14)),
    "function": lambda dtype: (operators.Function(laplacian, symmetric=True, nullspace="constant"), (1, 40)),
    "matrix": lambda dtype: (operators.Matrix(graph_laplacian(dtype), nullspace="constant"), (7,)),
    "csr": lambda dtype: (operators.Matrix(graph_laplacian(dtype).to_sparse_csr(), nullspace="constant"), (7,)),
    "function, not named": lambda dtype: (operators.Function(rough(dtype), symmetric=True), (1, 40)),
    "stencil, not named": lambda dtype: (insulated(16, dtype), (1, 16, 16)),
}
SOLVERS = {
    "cg": prdp.CG(300, 1e-5),
    "cg, diagonal": prdp.CG(300, 1e-5, preconditioner="diagonal"),
    "gmres": prdp.GMRES(40, rtol=1e-5, restart=30),
    "bicgstab": prdp.BiCGStab(300, 1e-5),
}


def same(found, expected):
    return torch.equal(found[0], expected[0]) and all(
        torch.equal(x, y) for x, y in zip(found[1][:3], expected[1][:3], strict=True)
    )


def has_diagonal(kind):
    return not kind.startswith("function")


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize(
    ("kind", "name"), [(k, n) for k in KINDS for n in SOLVERS if n != "cg, diagonal" or has_diagonal(k)]
)
def test_a_constant_is_no_start(kind, name, dtype):
    a, shape = KINDS[kind](dtype)
    b = mean_free(3, *shape, dtype=dtype)
    expected = prdp.linear_solve(a, b, SOLVERS[name])
    for size in (1.0, 1 / 3, -1e20, 1e-20):
        assert same(prdp.linear_solve(a, b, SOLVERS[name], x0=torch.full_like(b, size)), expected), size


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("method", ["cg", "bicgstab", "gmres"])
@pytest.mark.parametrize("kind", ["stencil", "matrix", "stencil, not named"])
def test_plain_tensors_say_the_same(kind, method, dtype):
    a, shape = KINDS[kind](dtype)
    b = mean_free(3, *shape, dtype=dtype)
    spec = (a.tensors, a.kind, a.shape, a.parameters, False, method, 200, 1e-5, 20)
    u, info = _C.solve_with_tensors(b, *spec, None)
    v, report = _C.solve_with_tensors(b, *spec, torch.full_like(b, 1 / 3))
    assert torch.equal(u, v) and torch.equal(info[0], report[0]) and torch.equal(info[2], report[2])


@settings(max_examples=60, deadline=None)
@given(
    n=st.sampled_from([4, 9, 20]), name=st.sampled_from(list(SOLVERS)), single=st.booleans(),
    size=st.integers(-12, 12), noise=st.integers(-12, 0), seed=st.integers(0, 10**6),
)  # fmt: skip
def test_a_start_near_the_null_space_is_never_worse_than_zero(n, name, single, size, noise, seed):
    """A constant, with noise that is more, or less, than its rounding."""
    dtype = F32 if single else F64
    a = diffusion((n, n), seed, dtype)
    b = mean_free(2, 1, n, n, dtype=dtype, seed=seed)
    x0 = (10.0**size * (1 + 10.0**noise * random(2, 1, n, n, seed=seed + 1))).to(dtype)
    solver = replace(SOLVERS[name], rtol=1e-4 if single else 1e-9)
    from_zero = prdp.linear_solve(a, b, solver)[1]
    u, info = prdp.linear_solve(a, b, solver, x0=x0)
    assert (from_zero.status > 0).all() and (info.status > 0).all()
    exact = diffusion((n, n), seed, F64) if not single else operators.Diffusion(a.tensors[0].double(), boundary="flux")
    left = (b.double() - exact.apply(u.double())).flatten(1).norm(dim=1) / b.double().flatten(1).norm(dim=1)
    assert (left < (1e-3 if single else 1.1e-9)).all()  # of single precision, the rounding of u counts as well


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_steps_start_from_a_uniform_state(backward):
    """Of an equation that keeps the state's mean free: the state is in the null space of A."""
    source = mean_free(2, 1, 16, 16, dtype=F32)
    outcomes = []
    for start in ("zero", "state"):
        step = prdp.ImplicitStep(diffusion((16, 16), 3), rhs=lambda u: source + 0 * u, solver=SOLVERS["cg"],
                                 start=start, backward=backward)  # fmt: skip
        outcomes.append((step(torch.full((2, 1, 16, 16), 0.3)), step.info))
    assert same(*outcomes) and (outcomes[0][1].status > 0).all()


@pytest.mark.parametrize("kind", ["stencil", "matrix"])
def test_the_derivative_of_the_iterations_is_that_from_zero(kind):
    a, shape = KINDS[kind](F64)
    b = mean_free(2, *shape, dtype=F64).requires_grad_()
    gradients = []
    for x0 in (None, torch.full_like(b, 0.3)):
        u, _ = prdp.linear_solve(a, b, prdp.CG(3, 0.0), backward="unrolled", x0=x0)
        first = torch.autograd.grad(u.square().sum(), b, create_graph=True)[0]
        gradients += [first.detach(), torch.autograd.grad(first.square().sum(), b)[0]]
    assert torch.equal(gradients[0], gradients[2])
    torch.testing.assert_close(gradients[1], gradients[3])


def test_a_start_beside_a_large_null_vector_still_helps():
    a = diffusion((20, 20), 5, F64)
    u = field((20, 20), batch=1)
    b = a.apply(u - u.mean())
    near = u + 1e-4 * field((20, 20), batch=1, seed=1) + 1e3
    with_start, without = (prdp.linear_solve(a, b, SOLVERS["cg"], x0=x0)[1].iterations for x0 in (near, None))
    assert with_start < 0.7 * without
