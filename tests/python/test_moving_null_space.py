"""Null spaces that depend on parameters: u has the derivative of the pseudo-inverse."""

import pytest
import torch
from helpers import modes

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
EDGES = [(i, (i + step) % 9) for i in range(9) for step in (1, 2)]
SOLVERS = {
    "direct": prdp.Direct(),
    "cg": prdp.CG(60, rtol=1e-13),
    "minres": prdp.MINRES(60, rtol=1e-13),
    "gmres": prdp.GMRES(20, restart=9, rtol=1e-13),
}


def laplacian(weights):
    """The symmetric normalised Laplacian of a graph; its null vector is √degree."""
    rows, columns = torch.tensor(EDGES).T
    a = torch.zeros(9, 9, dtype=F64).index_put((rows, columns), weights)
    a = a + a.T
    degree = a.sum(0)
    scale = degree.rsqrt()
    return torch.eye(9, dtype=F64) - scale[:, None] * a * scale, degree.sqrt()


def problem(seed=0):
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(len(EDGES), dtype=F64, generator=generator) + 0.5
    return weights.requires_grad_(), torch.randn(2, 9, dtype=F64, generator=generator).requires_grad_()


def in_range(f, vector):
    """f without its part along a null vector of Aᵀ, on which it depends as that does."""
    return f - (f @ vector)[:, None] * vector / vector.square().sum()


def solved(solver, backward="implicit"):
    def solution(weights, f):
        matrix, vector = laplacian(weights)
        a = operators.Matrix(matrix, nullspace=vector[None])
        return prdp.linear_solve(a, in_range(f, vector), solver, backward=backward)[0]

    return solution


def by_pinv(weights, f):
    matrix, vector = laplacian(weights)
    return in_range(f, vector) @ torch.linalg.pinv(matrix, hermitian=True).T


@modes
@pytest.mark.parametrize("name", SOLVERS)
def test_reverse_mode_is_that_of_the_pseudo_inverse(name, backward):
    if name == "direct" and backward == "unrolled":
        backward = "implicit"  # Direct has no iterations
    weights, f = problem()
    cotangent = torch.linspace(-1, 2, 18, dtype=F64).view(2, 9)
    u, exact = solved(SOLVERS[name], backward)(weights, f), by_pinv(weights, f)
    torch.testing.assert_close(u, exact, rtol=1e-10, atol=1e-11)
    for mine, other in zip(*(torch.autograd.grad(v, (weights, f), cotangent) for v in (u, exact)), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-9)


@pytest.mark.filterwarnings("ignore:`torch.jit.script")
def test_forward_mode_and_second_derivatives_are_those_of_the_pseudo_inverse():
    weights, f = problem(1)
    solution = solved(SOLVERS["direct"])
    tangents = torch.linspace(1, 2, len(weights), dtype=F64), torch.linspace(-1, 1, 18, dtype=F64).view(2, 9)
    found, exact = (torch.func.jvp(u, (weights.detach(), f.detach()), tangents) for u in (solution, by_pinv))
    for mine, other in zip(found, exact, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-10)
    assert torch.autograd.gradcheck(solution, (weights, f), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(solution, (weights, f))


def test_it_goes_through_vmap_and_compile():
    weights, f = problem(2)
    solution = solved(SOLVERS["minres"])
    whole = torch.func.grad(lambda w: solution(w, f.detach()).square().sum())
    expected = torch.autograd.grad(by_pinv(weights, f).square().sum(), weights)[0]
    several = torch.stack([weights.detach(), 2 * weights.detach()])  # a factor of all weights changes nothing
    for found, factor in zip(torch.func.vmap(whole)(several), (1, 2), strict=True):
        torch.testing.assert_close(found * factor, expected, rtol=1e-8, atol=1e-9)
    compiled = torch.compile(lambda w: solution(w, f.detach()).square().sum(), backend="aot_eager")
    (found,) = torch.autograd.grad(compiled(weights), weights)
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("transposed", [False, True])
def test_products_move_with_the_null_space(transposed):
    weights, f = problem(3)

    def product(weights, f):
        matrix, vector = laplacian(weights)
        a = operators.Matrix(matrix, nullspace=vector[None])
        return a.apply_transpose(f) if transposed else a.apply(f)

    assert torch.autograd.gradcheck(product, (weights, f))


def test_left_and_right_vectors_may_move_apart():
    """A Markov chain: (I - P) maps constants to zero, and its transpose the stationary distribution."""
    logits = torch.randn(6, 6, dtype=F64, generator=torch.Generator().manual_seed(4)).requires_grad_()
    f = torch.linspace(-1, 1, 6, dtype=F64)

    def parts(logits):
        a = torch.eye(6, dtype=F64) - logits.softmax(1)
        stationary = torch.linalg.solve((a + torch.ones(6, 6, dtype=F64)).T, torch.ones(6, dtype=F64))
        scale = 1 + torch.arange(6, dtype=F64) * logits[0, 0].exp()  # columns of A, so that the right vector moves
        a = a / scale
        return a, in_range(f[None], stationary), scale, stationary

    def mine(logits):
        a, b, right, left = parts(logits)
        found = prdp.linear_solve(operators.Matrix(a, right[None], left[None]), b, SOLVERS["gmres"])
        return found[0]

    def pinv(logits):
        a, b, *_ = parts(logits)
        return b @ torch.linalg.pinv(a).T

    torch.testing.assert_close(mine(logits), pinv(logits), rtol=1e-9, atol=1e-10)
    cotangent = torch.linspace(0, 1, 6, dtype=F64)[None]
    found, exact = (torch.autograd.grad(u(logits), logits, cotangent)[0] for u in (mine, pinv))
    torch.testing.assert_close(found, exact, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("of_all_channels", [False, True])
def test_vectors_of_a_channel_and_of_all_channels_move(of_all_channels):
    scale = (torch.rand(5, dtype=F64, generator=torch.Generator().manual_seed(5)) + 0.5).requires_grad_()
    f = torch.randn(3, 2, 5, dtype=F64, generator=torch.Generator().manual_seed(6))

    def product(v, scale):  # S L S, with L the periodic second difference: S⁻¹ 1 is its null vector
        v = scale * v
        return scale * (2 * v - v.roll(1, -1) - v.roll(-1, -1))

    def in_range_of_channels(vector):
        return f - (f @ vector)[..., None] * vector / vector.square().sum()

    def mine(scale):
        vector = 1 / scale
        basis = torch.eye(2, dtype=F64)[..., None] * vector if of_all_channels else vector[None]
        a = operators.Function(product, tensors=(scale,), symmetric=True, nullspace=basis)
        return prdp.linear_solve(a, in_range_of_channels(vector), prdp.CG(40, rtol=1e-13))[0]

    def exact(scale):
        matrix = product(torch.eye(5, dtype=F64), scale).T
        return in_range_of_channels(1 / scale) @ torch.linalg.pinv(matrix, hermitian=True)

    torch.testing.assert_close(mine(scale), exact(scale), rtol=1e-9, atol=1e-10)
    cotangent = torch.linspace(-1, 2, 30, dtype=F64).view(3, 2, 5)
    found, expected = (torch.autograd.grad(u(scale), scale, cotangent)[0] for u in (mine, exact))
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-9)


@modes
@pytest.mark.parametrize("moving", ["left", "right"])
def test_the_other_null_space_may_be_the_constant(moving, backward):
    """Rows of a ring, or columns, whose sums are zero, each times a weight."""
    n, generator = 7, torch.Generator().manual_seed(3)
    weights = (torch.rand(1, n, dtype=F64, generator=generator) + 0.5).requires_grad_()
    f = torch.randn(2, 1, n, dtype=F64, generator=generator)
    ones = torch.ones(1, n, dtype=F64)

    def by(constant):
        def solution(weights):
            of_neighbours = [1 / weights.roll(step, -1) for step in (1, -1)] if moving == "right" else [1 / weights] * 2
            c = torch.stack([2 / weights, *(-c for c in of_neighbours)], 1)
            bases = (constant, weights) if moving == "left" else (weights, constant)
            left = weights if moving == "left" else ones
            b = f - (f * left).sum(-1, keepdim=True) * left / left.square().sum()
            a = operators.Stencil(c, [(0,), (-1,), (1,)], "periodic", nullspace=bases[0], left_nullspace=bases[1])
            return prdp.linear_solve(a, b, SOLVERS["gmres"], backward=backward)[0]

        return solution

    torch.testing.assert_close(by("constant")(weights), by(ones)(weights), rtol=1e-10, atol=1e-11)
    assert torch.autograd.gradcheck(by("constant"), weights)
