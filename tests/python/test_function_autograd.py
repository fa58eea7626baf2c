"""Products that differentiate or map by themselves: in a solve they give what they give outside."""

import pytest
import torch
from torch.autograd import forward_ad

import prdp_torch as prdp
from prdp_torch import operators

N = 5
POINT = torch.linspace(0.5, 1.5, N, dtype=torch.float64)
RHS = torch.randn(1, N, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def energy(x):
    return (x**4).sum() + (x[1:] * x[:-1]).square().sum()


HESSIAN = torch.func.hessian(energy)(POINT) + 5 * torch.eye(N, dtype=torch.float64)


def by_hvp(v):
    return torch.autograd.functional.hvp(energy, POINT, v[0])[1][None] + 5 * v


def by_grad(v):
    with torch.enable_grad():
        x = POINT.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(energy(x), x, create_graph=True)
        return torch.autograd.grad(gradient, x, v[0])[0][None] + 5 * v


def by_dual_numbers(v):
    with forward_ad.dual_level():
        gradient = torch.func.grad(energy)(forward_ad.make_dual(POINT, v[0]))
        return forward_ad.unpack_dual(gradient).tangent[None] + 5 * v


def by_jvp(v):
    return torch.func.jvp(torch.func.grad(energy), (POINT,), (v[0],))[1][None] + 5 * v


def by_vjp(v):
    return torch.func.vjp(torch.func.grad(energy), POINT)[1](v[0])[0][None] + 5 * v


def by_vmap(v):
    return torch.vmap(lambda w: HESSIAN @ w)(v)


PRODUCTS = [by_hvp, by_grad, by_dual_numbers, by_jvp, by_vjp, by_vmap]


def solve(product, b, solver, **settings):
    return prdp.linear_solve(operators.Function(product, symmetric=True), b, solver, **settings)


@pytest.mark.parametrize("backward", ["implicit", "unrolled", "none"])
@pytest.mark.parametrize("solver", [prdp.CG(20, rtol=1e-12), prdp.GMRES(5, rtol=1e-12), prdp.Direct()], ids=repr)
@pytest.mark.parametrize("product", PRODUCTS)
def test_a_product_may_differentiate(product, solver, backward):
    if isinstance(solver, prdp.Direct) and backward == "unrolled":
        return
    b = RHS.clone().requires_grad_()
    u, info = solve(product, b, solver, backward=backward)
    torch.testing.assert_close(u, torch.linalg.solve(HESSIAN, RHS[0])[None], rtol=1e-9, atol=1e-10)
    assert (HESSIAN @ u[0] - b[0]).norm() < 1e-9 * b.norm() and info.solved.all()
    if backward == "none":
        assert not u.requires_grad
        return
    (gradient,) = torch.autograd.grad(u.sum(), b)
    expected = torch.linalg.solve(HESSIAN, torch.ones(N, dtype=torch.float64))[None]
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("product", PRODUCTS)
def test_a_compiled_solve_with_it_is_right_from_the_first_call_on(product):
    torch._dynamo.reset()
    a = operators.Function(product, symmetric=True)
    compiled = torch.compile(lambda b: prdp.linear_solve(a, b, prdp.CG(20, rtol=1e-12))[0], backend="aot_eager")
    exact = torch.linalg.solve(HESSIAN, RHS[0])[None]
    for _ in range(2):
        torch.testing.assert_close(compiled(RHS), exact, rtol=1e-9, atol=1e-10)
    b = RHS.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(compiled(b), b, exact)
    torch.testing.assert_close(gradient, torch.linalg.solve(HESSIAN, exact[0])[None], rtol=1e-9, atol=1e-10)


def test_newtons_method_with_an_operator_of_the_library_is_compiled():
    torch._dynamo.reset()
    diffusion = operators.Diffusion(torch.ones(1, 8, dtype=torch.float64))
    point, b = torch.full((1, 1, 8), 0.3, dtype=torch.float64), torch.ones(1, 1, 8, dtype=torch.float64)
    a = operators.Function(lambda v: torch.func.jvp(lambda u: diffusion.apply(u) + u**3, (point,), (v,))[1])

    def f(b):
        return prdp.linear_solve(a, b, prdp.GMRES(4, rtol=1e-12))[0]

    exact = torch.linalg.solve(diffusion.dense() + 0.27 * torch.eye(8, dtype=torch.float64), b[0, 0])
    for solved in (f(b), torch.compile(f, backend="aot_eager")(b)):
        torch.testing.assert_close(solved[0, 0], exact, rtol=1e-9, atol=1e-10)


def test_a_conjugate_that_is_lazy_stays_one():
    """Inside a compiled graph's first call, torch switches off what resolves it."""
    torch._dynamo.reset()
    phase = torch.exp(1j * torch.arange(N, dtype=torch.float64))

    def product(v):
        return ((v * phase).conj() * phase).real * 2 + v

    a = operators.Function(product, symmetric=True)
    compiled = torch.compile(lambda b: prdp.linear_solve(a, b, prdp.CG(5, rtol=1e-12))[0], backend="aot_eager")
    torch.testing.assert_close(compiled(RHS), RHS / 3, rtol=1e-9, atol=1e-10)


def test_a_product_records_nothing_by_itself():
    recorded = []
    weight = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)

    def product(v, w):
        recorded.append(torch.is_grad_enabled())
        return v * w

    a = operators.Function(product, tensors=(weight,), symmetric=True)
    for _ in range(2):
        prdp.linear_solve(a, RHS, prdp.CG(3))
    recorded.clear()
    u, _ = prdp.linear_solve(a, RHS, prdp.CG(3))
    assert recorded.count(True) <= 1 and u.requires_grad  # one looks for captures
    u.sum().backward()
    torch.testing.assert_close(weight.grad, -(RHS / 4).sum())
