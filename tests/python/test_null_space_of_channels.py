"""Null vectors of all channels together, such as the constant of a pressure beside velocities."""

import numpy as np
import pytest
import torch
from helpers import field, random, statuses
from test_null_space import a_range, dense_of, periodic_stencil

import prdp_torch as prdp
from prdp_torch import _C, operators

F64 = torch.float64
N = 9


def forward(p):
    return p.roll(-1, -1) - p


def backward(u):
    return u.roll(1, -1) - u


def saddle(v, weight):
    """(w u + ∂ᵀp, ∂u) of a velocity and a pressure on a periodic line: symmetric; it forgets the mean of p alone."""
    u, p = v.unbind(1)
    return torch.stack([weight * u + backward(p), forward(u)], 1)


def skew(v, weight):
    """(w u + ∂ᵀp + p, ∂u): what it and its transpose forget differs."""
    u, p = v.unbind(1)
    return torch.stack([weight * u + backward(p), forward(u) + 0.3 * forward(p.roll(2, -1)) * weight], 1)


PRESSURE = torch.stack([torch.zeros(N, dtype=F64), torch.ones(N, dtype=F64)])[None]  # (k, channels, *shape)
WEIGHT = 1 + torch.rand(N, dtype=F64, generator=torch.Generator().manual_seed(4))


def stokes(weight=WEIGHT, nullspace=PRESSURE):
    return operators.Function(saddle, tensors=(weight,), symmetric=True, nullspace=nullspace)


def oblique():
    """With null vectors of A and Aᵀ by dense algebra."""
    a = operators.Function(skew, tensors=(WEIGHT,))
    m = torch.from_numpy(dense_of(a, (1, 2, N)))
    u, s, vh = torch.linalg.svd(m)
    assert s[-1] < 1e-12 < s[-2]
    return operators.Function(
        skew, tensors=(WEIGHT,), nullspace=vh[-1].reshape(1, 2, N), left_nullspace=u[:, -1].reshape(1, 2, N)
    )


KINDS = {"stokes": stokes, "oblique": oblique}
SOLVERS = {"gmres": prdp.GMRES(8, rtol=1e-11, restart=20), "direct": prdp.Direct()}


@pytest.mark.filterwarnings("ignore:`torch.jit.script")
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("kind", KINDS)
def test_u_and_both_derivatives_are_those_of_the_pseudo_inverse(kind, name):
    a, shape = KINDS[kind](), (3, 2, N)
    inverse = torch.from_numpy(np.linalg.pinv(dense_of(a, shape), rcond=1e-10))
    b = a_range(a, random(*shape), shape).requires_grad_()
    u, info = prdp.linear_solve(a, b, SOLVERS[name])
    assert (info.status > 0).all()
    torch.testing.assert_close(u.flatten(1), b.flatten(1) @ inverse.T, rtol=0, atol=1e-8)
    cotangent = random(*shape, seed=1)  # has a part in the null space
    (b_bar,) = torch.autograd.grad(u, b, cotangent)
    torch.testing.assert_close(b_bar.flatten(1), cotangent.flatten(1) @ inverse, rtol=0, atol=1e-8)

    def solution(b):
        return prdp.linear_solve(a, b, SOLVERS[name])[0]

    tangent = torch.func.jvp(solution, (b.detach(),), (cotangent,))[1]
    torch.testing.assert_close(tangent.flatten(1), cotangent.flatten(1) @ inverse.T, rtol=0, atol=1e-8)


@pytest.mark.filterwarnings("ignore:`torch.jit.script")
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_gradients_for_the_tensors_of_a(backward):
    b = random(2, 2, N)
    b[:, 1] -= b[:, 1].mean(-1, keepdim=True)

    def loss(weight, b):
        b = torch.stack([b[:, 0], b[:, 1] - b[:, 1].mean(-1, keepdim=True)], 1)
        return prdp.linear_solve(stokes(weight), b, prdp.GMRES(3, rtol=1e-12, restart=20), backward=backward)[0]

    assert torch.autograd.gradcheck(
        loss, (WEIGHT.clone().requires_grad_(), b.requires_grad_()), check_forward_ad=True, fast_mode=True
    )


def test_a_mean_of_the_pressure_is_told_and_one_of_the_velocity_is_not():
    b = a_range(stokes(), random(2, 2, N), (2, 2, N))
    b[0, 1] += 0.5
    b[1, 0] += 0.5
    _, info = prdp.linear_solve(stokes(), b, SOLVERS["gmres"], on_failure="return")
    assert statuses(info)[0] == "INCONSISTENT" and info.status[1] > 0
    with pytest.raises(ValueError, match="Function: vector 0 of nullspace is not in the null space of A"):
        prdp.linear_solve(stokes(nullspace="constant"), b, SOLVERS["gmres"])  # of the velocity it is none
    assert prdp.check_operator(stokes(), torch.zeros(2, 2, N, dtype=F64))


OF_STENCILS = {
    "cg": prdp.CG(100, rtol=1e-11),
    "cg, multigrid": prdp.CG(40, rtol=1e-11, preconditioner="multigrid"),
    "gmres": prdp.GMRES(20, rtol=1e-11, restart=30),
    "direct": prdp.Direct(),
}


@pytest.mark.parametrize("name", OF_STENCILS)
@pytest.mark.parametrize("shape", [(11,), (5, 6), (3, 4, 5)])
def test_constants_of_all_channels_are_the_constant_of_each(shape, name):
    """In another basis: both channels alike, and against each other."""
    ones = torch.ones(shape, dtype=F64)
    basis = torch.stack([torch.stack([ones, ones]), torch.stack([ones, -ones])])
    together, each = periodic_stencil(shape, nullspace=basis), periodic_stencil(shape)
    b = field(shape, channels=2)
    b = (b - b.mean(tuple(range(2, b.dim())), keepdim=True)).requires_grad_()
    (u, info), (v, _) = (prdp.linear_solve(a, b, OF_STENCILS[name]) for a in (together, each))
    assert (info.status > 0).all()
    torch.testing.assert_close(u, v, rtol=0, atol=1e-8)
    cotangent = field(shape, channels=2, seed=1)
    for found, expected in zip(torch.autograd.grad(u, b, cotangent), torch.autograd.grad(v, b, cotangent), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-8)
    spec = (together.tensors, together.kind, together.shape, together.parameters, False)
    if name in ("cg", "gmres"):
        w, report = _C.solve_with_tensors(b.detach(), *spec, name, 100, 1e-11, 30)
        assert (report[2] > 0).all()
        torch.testing.assert_close(w, u.detach(), rtol=0, atol=1e-8)


def test_other_shapes_are_refused():
    b = random(2, 2, N)
    for wrong in (torch.ones(1, 3, N, dtype=F64), torch.ones(1, 2, N + 1, dtype=F64), torch.ones(N, dtype=F64)):
        with pytest.raises(ValueError, match=r"Function: a null space must have shape \(k, \*shape\).*\(k, channels, "):
            prdp.linear_solve(stokes(nullspace=wrong), b, SOLVERS["gmres"])
    a = operators.Matrix(torch.zeros(N, N, dtype=F64), nullspace=torch.ones(1, 1, 1, N, dtype=F64))
    with pytest.raises(
        ValueError, match=r"Matrix: a null space must have shape \(k, \*shape\).*\(batch, k, n\); got \[1, 1, 1, 9\]"
    ):
        prdp.linear_solve(a, b[:, 0], prdp.CG(3))
    mixed = operators.Function(saddle, tensors=(WEIGHT,), nullspace=PRESSURE, left_nullspace="constant")
    with pytest.raises(ValueError, match="Function: nullspace and left_nullspace must both be of one channel, or both"):
        prdp.linear_solve(mixed, b, SOLVERS["gmres"])


def exchange(coupling):
    """Two temperatures that exchange heat: only the constant of both together is mapped to zero."""

    def product(v):
        e = coupling * (v[:, 0] - v[:, 1])
        return 2 * v - v.roll(1, -1) - v.roll(-1, -1) + torch.stack([e, -e], 1)

    return product


def test_a_null_vector_of_all_channels_is_no_constant_of_each():
    n = 8
    g = torch.Generator().manual_seed(0)
    product = exchange(torch.rand(n, dtype=torch.float64, generator=g) + 0.5)
    b = torch.randn(1, 2, n, dtype=torch.float64, generator=g)
    b -= b.mean()
    solver = prdp.CG(60, rtol=1e-10)

    def function(nullspace=None):
        return prdp.operators.Function(product, symmetric=True, nullspace=nullspace)

    with pytest.raises(
        torch.linalg.LinAlgError, match=r"of all channels together as a vector, nullspace=torch.ones\(1, 2, 8\)"
    ):
        prdp.linear_solve(function(), b + 1, solver)
    with pytest.raises(ValueError, match=r"nullspace=torch.ones\(1, 2, 8\)"):
        prdp.check_operator(function(), b)
    with pytest.raises(ValueError, match=r"in each channel alone: one of all channels has shape \(1, channels"):
        prdp.linear_solve(function("constant"), b, solver)
    named = function(torch.ones(1, 2, n, dtype=torch.float64))
    assert prdp.check_operator(named, b)
    u, info = prdp.linear_solve(named, b, solver)
    assert info.solved.all() and (product(u) - b).norm() < 1e-9 * b.norm()
    for solver in (prdp.GMRES(100, rtol=1e-10), prdp.BiCGStab(300, rtol=1e-10)):
        with pytest.raises(torch.linalg.LinAlgError, match=r"nullspace=torch.ones\(1, 2, 8\)"):
            prdp.linear_solve(function(), b + 1, solver)
    # Of each channel, the name is that of before.
    apart = prdp.operators.Function(exchange(0.0), symmetric=True)
    with pytest.raises(ValueError, match="nullspace='constant'"):
        prdp.check_operator(apart, b)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("channels, nodes", [(2, 3000), (3, 20000)])
def test_the_rounding_of_a_hub_is_not_held_against_the_constant(channels, nodes, dtype):
    leaf, hub = torch.arange(1, nodes), torch.zeros(nodes - 1, dtype=torch.long)
    degree = torch.ones(nodes, dtype=dtype)
    degree[0] = nodes - 1

    def laplacian(v):
        along = torch.zeros_like(v).index_add(-1, hub, v[..., leaf]).index_add(-1, leaf, v[..., hub])
        return degree * v - along

    b = torch.randn(1, channels, nodes, dtype=dtype, generator=torch.Generator().manual_seed(0))
    b -= b.mean(-1, keepdim=True)
    a = operators.Function(laplacian, symmetric=True, nullspace="constant")
    _, info = prdp.linear_solve(a, b, prdp.CG(50, rtol=1e-4))
    assert info.solved.all()


@pytest.mark.parametrize("weight", [1e-6, 1e-8])
def test_a_small_cotangent_beside_the_sum_of_another_channel_is_kept(weight):
    n = 64
    b = torch.randn(1, 2, n, generator=torch.Generator().manual_seed(0))
    b = (b - b.mean(-1, keepdim=True)).requires_grad_()
    wave = torch.sin(torch.arange(n) * 1.0)
    a = operators.Diffusion(torch.ones(1, n), boundary="flux", length=float(n))
    u, _ = prdp.linear_solve(a, b, prdp.CG(200, rtol=1e-6))
    (both,) = torch.autograd.grad(u[:, 0].sum() + weight * (u[:, 1] * wave).sum(), b, retain_graph=True)
    (alone,) = torch.autograd.grad((u[:, 1] * wave).sum(), b)
    torch.testing.assert_close(both[0, 1], weight * alone[0, 1], rtol=1e-3, atol=1e-9 * weight)
