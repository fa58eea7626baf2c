"""Derivatives of solves from an x0: those of the iterations from a constant start, and none of the start."""

import pytest
import torch
from helpers import dense_laplacian, field, modes, random, spd_matrices
from starts import GENERAL, SYMMETRIC

import prdp_torch as prdp
from prdp_torch import operators

UNROLLED = {
    "heat": (lambda nu: operators.Heat((7,), nu, 1.0), (torch.tensor(2e-3, dtype=torch.float64),), (1, 7), SYMMETRIC),
    "dense": (operators.Matrix, (spd_matrices(3, 6),), (6,), [*GENERAL, prdp.CG]),
    "dense_shared": (operators.Matrix, (spd_matrices(1, 6)[0],), (6,), [*GENERAL, prdp.CG]),
    "function": (
        lambda m: operators.Function(lambda v, m: v @ m.mT, lambda v, m: v @ m, (m,), lambda m: m.diagonal()),
        (spd_matrices(1, 6)[0],),
        (6,),
        [*GENERAL, prdp.CG],
    ),
    "burgers": (
        lambda w, nu: operators.Burgers(w, nu, 0.2),
        (field((6,), 3, 1), torch.tensor(2e-2, dtype=torch.float64)),
        (1, 6),
        GENERAL,
    ),
    "navier_stokes": (
        lambda w, nu: operators.NavierStokes(w, nu, 0.1),
        (field((3, 4), 3, 1, channels=3), torch.tensor(2e-2, dtype=torch.float64)),
        (3, 3, 4),
        [prdp.GMRES],
    ),
}
MAPS = [(name, method) for name, (*_, methods) in UNROLLED.items() for method in methods]


def unrolled_problem(name, method):
    make, tensors, shape, _ = UNROLLED[name]
    tensors = [t.clone().requires_grad_() for t in tensors]
    b, x0 = random(3, *shape, seed=4), random(3, *shape, seed=5)
    if name == "navier_stokes":
        b[:, 2] -= b[:, 2].mean((1, 2), keepdim=True)
    solver = method(3, rtol=0.0, **({"restart": 3} if method is prdp.GMRES else {}))
    return make, [b.requires_grad_(), *tensors], x0, solver


def composed(make, solver, x0, b, *tensors):
    """The same map in parts: iterations from zero for what a constant start leaves of b."""
    a = make(*tensors)
    start = prdp.linear_solve(a, b, type(solver)(0), x0=x0, backward="none")[0].detach()
    rest = b - a.apply(start)
    return start + prdp.linear_solve(a, rest, solver, backward="unrolled")[0]


@pytest.mark.parametrize("name, method", MAPS)
def test_the_unrolled_derivative_is_that_of_the_iterations_from_a_constant_start(name, method):
    make, inputs, x0, solver = unrolled_problem(name, method)
    bar = random(*inputs[0].shape, seed=6)
    expected = composed(make, solver, x0, *inputs)
    wanted = torch.autograd.grad(expected, inputs, bar, create_graph=True)

    def solve(b, *tensors, **options):
        return prdp.linear_solve(make(*tensors), b, solver, backward="unrolled", x0=x0, **options)[0]

    for every in (None, 1, 2, "sqrt"):
        u = solve(*inputs, checkpoint_every=every)
        torch.testing.assert_close(u, expected, rtol=1e-9, atol=1e-11)
        for found, truth in zip(torch.autograd.grad(u, inputs, bar), wanted, strict=True):
            torch.testing.assert_close(found, truth, rtol=1e-7, atol=1e-9)
    # with a gradient for b alone, a shorter way
    b = inputs[0].detach().requires_grad_()
    (of_b,) = torch.autograd.grad(solve(b, *[t.detach() for t in inputs[1:]]), b, bar)
    torch.testing.assert_close(of_b, wanted[0], rtol=1e-7, atol=1e-9)
    # second derivatives
    again = torch.autograd.grad(solve(*inputs), inputs, bar, create_graph=True)
    weights = [random(*g.shape, seed=7) for g in again]
    seconds = [
        torch.autograd.grad(
            sum((g * w).sum() for g, w in zip(gradients, weights, strict=True)), inputs, materialize_grads=True
        )
        for gradients in (again, wanted)
    ]
    for found, truth in zip(*seconds, strict=True):
        torch.testing.assert_close(found, truth, rtol=1e-6, atol=1e-8)


@pytest.mark.filterwarnings("ignore:`torch.jit.script")
@pytest.mark.parametrize("name, method", [case for case in MAPS if case[0] in ("heat", "dense", "burgers")])
def test_forward_mode_is_the_transpose_of_reverse_mode(name, method):
    make, inputs, x0, solver = unrolled_problem(name, method)

    def solve(b, *tensors):
        return prdp.linear_solve(make(*tensors), b, solver, backward="unrolled", x0=x0)[0]

    inputs = tuple(t.detach() for t in inputs)
    tangents = tuple(random(*t.shape, seed=8) for t in inputs)
    u, along = torch.func.jvp(solve, inputs, tangents)
    back = torch.func.vjp(solve, *inputs)[1](bar := random(*u.shape, seed=9))
    forward = sum((t * g).sum() for t, g in zip(tangents, back, strict=True))
    torch.testing.assert_close((along * bar).sum(), forward, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("method", [prdp.Jacobi, prdp.SteepestDescent])
def test_the_iterations_are_the_textbook_ones(method):
    """K iterations written out, from a constant start, with the gradient that autograd has of them."""
    a, x0 = spd_matrices(1, 6)[0].requires_grad_(), random(2, 6, seed=5)
    b = random(2, 6, seed=4).requires_grad_()
    x = x0 * (torch.linalg.vecdot(b, x0 @ a.mT) / (x0 @ a.mT).square().sum(1))[:, None]
    x = x.detach()
    for _ in range(4):
        r = b - x @ a.mT
        if method is prdp.Jacobi:
            x = x + r / a.diagonal()
        else:
            x = x + (r.square().sum(1) / (r * (r @ a.mT)).sum(1))[:, None] * r
    bar = random(2, 6, seed=6)
    u, _ = prdp.linear_solve(a, b, method(4, rtol=0.0), backward="unrolled", x0=x0)
    torch.testing.assert_close(u, x, rtol=1e-12, atol=1e-14)
    for found, truth in zip(torch.autograd.grad(u, (b, a), bar), torch.autograd.grad(x, (b, a), bar), strict=True):
        torch.testing.assert_close(found, truth, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("method", [prdp.SteepestDescent, prdp.CG, prdp.BiCGStab])
def test_the_derivative_follows_a_solve_that_went_on_from_its_true_residual(method):
    """In float32 and below its rounding, a recursive residual claims a tolerance that the true one does not meet."""
    nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    b, x0 = field((30,), 3, dtype=torch.float32), field((30,), 3, 1, dtype=torch.float32)
    gradients = []
    for dtype in (torch.float32, torch.float64):
        u, _ = prdp.linear_solve(
            operators.Heat((30,), nu, 1.0), b.to(dtype), method(12, rtol=1e-7), backward="unrolled", x0=x0.to(dtype),
            checkpoint_every=3,
        )  # fmt: skip
        gradients.append(torch.autograd.grad(u.square().sum(), nu)[0])
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=0)


@modes
def test_a_start_gets_no_gradient_and_the_adjoint_solve_none_of_the_start(backward):
    nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    b, x0 = field((9,)).requires_grad_(), field((9,), seed=1).requires_grad_()
    u, _ = prdp.linear_solve(operators.Heat((9,), nu, 1.0), b, prdp.CG(4, rtol=0.0), backward=backward, x0=x0)
    assert torch.autograd.grad(u.sum(), (b, x0, nu), allow_unused=True, retain_graph=True)[1] is None
    if backward == "implicit":
        other, _ = prdp.linear_solve(operators.Heat((9,), nu, 1.0), b, prdp.CG(4, rtol=0.0))
        of_start, of_zero = (torch.autograd.grad(v.sum(), b)[0] for v in (u, other))
        assert torch.equal(of_start, of_zero)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(x0.detach(), torch.ones_like(x0))
        v, _ = prdp.linear_solve(operators.Heat((9,), 1e-3, 1.0), b.detach(), prdp.CG(4), backward=backward, x0=dual)
        assert torch.autograd.forward_ad.unpack_dual(v).tangent is None


@modes
@pytest.mark.parametrize("method", SYMMETRIC)
def test_converged_gradients_are_those_of_dense_solves(method, backward):
    nu = torch.tensor(2e-3, dtype=torch.float64, requires_grad=True)
    b, x0 = field((8,)).requires_grad_(), field((8,), seed=1)
    bar = field((8,), seed=2)
    u, _ = prdp.linear_solve(
        operators.Heat((8,), nu, 1.0), b, method(400, rtol=1e-12), backward=backward, adjoint_rtol=1e-12, x0=x0
    )
    dense = torch.eye(8, dtype=torch.float64) - nu * torch.from_numpy(dense_laplacian((8,)))
    truth = torch.linalg.solve(dense, b[:, 0].mT).mT[:, None]
    for found, wanted in zip(
        torch.autograd.grad(u, (b, nu), bar), torch.autograd.grad(truth, (b, nu), bar), strict=True
    ):
        torch.testing.assert_close(found, wanted, rtol=1e-8, atol=1e-9)
