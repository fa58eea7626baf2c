"""Gradients where a sample has no cotangent, overflows or is refused: what the others get, alone and beside it."""

import pytest
import torch
from torch.func import functional_call, grad, jvp, vjp

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64


def noise(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def heat(nu):
    return operators.Heat((30,), nu, 1.0)


def cell(coefficients):
    return operators.Stencil(coefficients, [(0,)])


@pytest.mark.parametrize("method", [prdp.CG, prdp.SteepestDescent, prdp.BiCGStab, prdp.GMRES])
@pytest.mark.parametrize("iterations", [1, 2])
@pytest.mark.parametrize("kind", ["matrix", "heat", "cell"])
def test_an_unrolled_sample_without_a_cotangent_adds_nothing(method, iterations, kind):
    """After one iteration from zero, its A is in no operation whose result has a cotangent."""
    t, b = {
        "matrix": (torch.tensor([[2.0, 0.1], [0.1, 2.0]], dtype=F64), noise(3, 2)),
        "heat": (torch.tensor(3e-4, dtype=F64), noise(3, 1, 30)),
        "cell": (torch.full((1, 1, 1), 2.0, dtype=F64), noise(3, 1, 1)),
    }[kind]
    t.requires_grad_()

    def gradient(rows):
        a = {"matrix": operators.Matrix, "heat": heat, "cell": cell}[kind](t)
        u, _ = prdp.linear_solve(a, b[rows], method(iterations, rtol=0.5), backward="unrolled")
        return torch.autograd.grad(u[0].sum(), t)[0]

    torch.testing.assert_close(gradient(slice(0, 3)), gradient(slice(0, 1)), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("dtype, large", [(torch.float32, 1e37), (F64, 1e307)])
@pytest.mark.parametrize("equation", [operators.Heat, operators.Burgers])
def test_a_gradient_that_overflows_leaves_that_of_its_neighbours(equation, dtype, large, backward):
    """The products of the large u alone leave the range, with either sign."""
    nu = torch.tensor(0.05, dtype=dtype, requires_grad=True)
    b = noise(3, 1, 9, dtype=dtype)
    b[0] *= large

    def gradient(rows):
        winds = b[rows].sign()
        a = operators.Heat((9,), nu, 0.7, 0.5) if equation is operators.Heat else equation(winds, nu, 0.02, 0.5)
        u, info = prdp.linear_solve(a, b[rows], prdp.BiCGStab(100), backward=backward, on_failure="return")
        return torch.autograd.grad(u.sum(), nu)[0], info.adjoint.status.tolist()

    of_batch, statuses = gradient(slice(0, 3))
    of_others, _ = gradient(slice(1, 3))
    overflow = int(prdp.SolveStatus.OVERFLOW)
    if statuses[0] == overflow:
        torch.testing.assert_close(of_batch, of_others, rtol=1e-5, atol=0)
    else:  # it did fit
        assert of_batch.isfinite() and of_batch.abs() > 1e-3 * large
    assert overflow not in statuses[1:] and of_others != 0


def diffusion_solve(b, rows):
    def f(kappa, h):
        a = operators.Diffusion(kappa[rows], boundary=("robin", h))
        return prdp.linear_solve(a, b[rows], prdp.CG(100, rtol=1e-12), on_failure="zero_grad")[0].square().sum()

    return f


@pytest.mark.parametrize("bad", [float("nan"), 0.0, -1.0])
def test_second_derivatives_are_those_of_the_healthy_samples(bad):
    b, kappa, along = noise(2, 1, 6), noise(2, 6, seed=1).exp(), noise(2, 6, seed=2)
    h, one = torch.tensor(1.3, dtype=F64), torch.ones((), dtype=F64)
    both, healthy = diffusion_solve(b, slice(0, 2)), diffusion_solve(b, slice(0, 1))
    expected = jvp(grad(healthy, (0, 1)), (kappa, h), (along, one))[1]
    refused = torch.stack([kappa[0], kappa[1] if bad < 0 else torch.full((6,), bad, dtype=F64)])
    refused[1, 0] = bad

    found = jvp(grad(both, (0, 1)), (refused, h), (along, one))[1]
    for mine, true in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, true, rtol=1e-8, atol=1e-10)

    leaves = refused.clone().requires_grad_(), h.clone().requires_grad_()
    first = torch.autograd.grad(both(*leaves), leaves, create_graph=True)
    second = torch.autograd.grad((first[0] * along).sum() + first[1], leaves)
    for mine, true in zip(second, expected, strict=True):
        torch.testing.assert_close(mine, true, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("mean", [0.0, 0.7])
def test_hessian_vector_products_of_a_singular_operator_in_every_order(mean):
    """The direction of a second derivative is taken without its part in the null space, as a cotangent is."""
    a = operators.Diffusion(noise(1, 8).exp(), boundary="flux")
    b, v = noise(1, 1, 8, seed=1), noise(1, 1, 8, seed=2)
    b, v = b - b.mean(), v - v.mean() + mean

    def f(b):
        return prdp.linear_solve(a, b, prdp.CG(100, rtol=1e-12))[0].square().sum()

    expected = jvp(grad(f), (b,), (v,))[1]
    dense = torch.func.hessian(f)(b).reshape(8, 8)
    for found in (
        torch.autograd.functional.hvp(f, b, v)[1],
        torch.autograd.functional.vhp(f, b, v)[1],
        torch.func.vjp(grad(f), b)[1](v)[0],
        (dense @ v.flatten()).reshape_as(b),
    ):
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)
    assert expected.norm() > 1e-2


@pytest.mark.parametrize("on_failure", ["return", "zero_grad"])
def test_a_refused_matrix_with_a_pattern_of_its_own_leaves_its_neighbours_their_gradient(on_failure):
    crow, col = torch.tensor([[0, 1, 2]] * 2), torch.tensor([[0, 1]] * 2)
    values = torch.tensor([[2.0, 3.0], [float("nan"), 3.0]], dtype=F64)

    def loss(values):
        a = operators.Matrix.csr(crow, col, values, (2, 2, 2))
        return prdp.linear_solve(a, torch.ones(2, 2, dtype=F64), prdp.GMRES(9), on_failure=on_failure)[0].sum()

    expected = torch.tensor([[-1 / 4, -1 / 9], [0.0, 0.0]], dtype=F64)
    torch.testing.assert_close(grad(loss)(values), expected, rtol=1e-8, atol=0)


def by_compile(network, x, loss, steps):
    torch._dynamo.reset()
    compiled = torch.compile(lambda x: steps(network(x)), backend="aot_eager", fullgraph=True)
    return torch.autograd.grad(loss(compiled(x)), network.weight)[0]


def of_weights(network, x, loss, steps):
    weights = {name: p.detach() for name, p in network.named_parameters()}
    return weights, lambda weights: loss(steps(functional_call(network, weights, (x,))))


def by_grad(*of):
    weights, value = of_weights(*of)
    return grad(value)(weights)["weight"]


def by_vjp(*of):
    weights, value = of_weights(*of)
    return vjp(value, weights)[1](torch.ones((), dtype=F64))[0]["weight"]


@pytest.mark.parametrize("on_failure", ["zero_grad", "return"])
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    "way, part",  # a Function cannot be made within a compiled graph
    [(way, part) for way in (by_compile, by_grad, by_vjp) for part in ("rhs", "operator", "stencil", "root")]
    + [(by_grad, "function"), (by_vjp, "function")],
)
def test_in_a_graph_an_infinite_derivative_of_a_refused_sample_reaches_no_weight(way, count, part, on_failure):
    """The zero cotangent of the sample, times the derivative of exp(u) = Inf, is NaN in what made its state."""
    torch.manual_seed(0)
    network, x = torch.nn.Linear(16, 16).double(), noise(4, 1, 16)
    x[2] *= 0.0 if part == "root" else 1e5
    network.bias.data.zero_()
    a = {
        "rhs": operators.Heat((16,), 1e-2, 0.1),
        "operator": lambda u: operators.Diffusion(torch.exp(u[:, 0]), 1.0),
        "root": lambda u: operators.Diffusion(u[:, 0].abs().sqrt(), 1.0),  # refused where κ = 0
        "function": lambda u: operators.Function(lambda v, e: (2 + e) * v, tensors=torch.exp(u), symmetric=True),
        "stencil": lambda u: operators.Stencil(torch.stack([2 + torch.exp(u[:, 0]), -u[:, 0].tanh()], 1), [(0,), (1,)]),
    }[part]
    rhs = (lambda u: u + 0.1 * torch.exp(u)) if part == "rhs" else None
    step = prdp.ImplicitStep(a, rhs, prdp.GMRES(40, rtol=1e-10), on_failure=on_failure)

    def steps(u):
        return step.rollout(u, count)[:, 1:]

    def loss(states):
        weights = torch.tensor([1.0, 1.0, 0.0, 1.0], dtype=F64)[: len(states)] if len(states) == 4 else torch.ones(3)
        return (states * weights[:, None, None, None]).square().sum()

    found = way(network, x, loss, steps)
    healthy = x[[0, 1, 3]]
    expected = torch.autograd.grad(loss(steps(network(healthy))), network.weight)[0]
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)
