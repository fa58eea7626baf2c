"""torch.func and forward mode through linear solves, against torch.linalg.solve; tensors in disguise."""

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from helpers import field, random, spd_matrices
from torch.autograd import gradcheck, gradgradcheck
from torch.func import grad, hessian, jacfwd, jacrev, jvp, linearize, vjp, vmap
from torch.utils._pytree import tree_leaves
from transforms import SECOND, SECOND_NAMES, close

import prdp_torch as prdp
from prdp_torch import operators
from prdp_torch.solvers import packed_options

# torch's own forward mode warns when it is first used.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script")
PATTERN = torch.tensor([[1.0, 1, 0, 0], [0, 1, 1, 0], [1, 0, 1, 0], [0, 1, 0, 1]], dtype=torch.float64).bool()


def dense_solve(solver, backward="implicit"):
    return lambda a, b: prdp.linear_solve(a, b, solver, backward=backward)[0]


def csr_solve(solver, backward="implicit"):
    """By the op, since torch makes no sparse tensors of tensors that it transforms."""
    csr = PATTERN.double().to_sparse_csr()
    crow, col, (row, column) = csr.crow_indices(), csr.col_indices(), PATTERN.nonzero().unbind(1)

    def solve(a, b):
        tensors = [crow, col, a[row, column]]
        options = packed_options(solver.method, solver.max_iter, solver.rtol, solver.restart, None, backward)
        return torch.ops.prdp.linear_solve(b[None], tensors, "csr", [], [], False, None, *options)[0][0]

    return solve


def function_solve(solver, backward="implicit"):
    def solve(a, b):
        product = operators.Function(lambda v, a: v @ a.mT, lambda v, a: v @ a, (a,))
        return prdp.linear_solve(product, b[None], solver, backward=backward)[0][0]

    return solve


def function_alone_solve(solver, backward="implicit"):
    """By a matvec whose transpose is torch's own derivative, and through an ImplicitStep."""

    def solve(a, b):
        product = operators.Function(lambda v, a: v @ a.mT, tensors=(a,))
        return prdp.ImplicitStep(product, None, solver, backward)(b[None])[0]

    return solve


MATRICES = [
    (dense_solve, "dense"),
    (csr_solve, "csr"),
    (function_solve, "function"),
    (function_alone_solve, "function_alone"),
]
matrices = pytest.mark.parametrize("kind", [m[0] for m in MATRICES], ids=[m[1] for m in MATRICES])


def matrix_and_vector():
    a = torch.where(PATTERN, 0.4 * random(4, 4, seed=1), 0.0) + 3 * torch.eye(4, dtype=torch.float64)
    return a, random(4, seed=2)


def reference(kind):
    return torch.linalg.solve if kind is not csr_solve else lambda a, b: torch.linalg.solve(a * PATTERN, b)


@matrices
@pytest.mark.parametrize("solver", [prdp.GMRES(9, restart=4, rtol=1e-14), prdp.Direct()], ids=["gmres", "direct"])
def test_first_derivatives_equal_those_of_lapack(kind, solver):
    given = matrix_and_vector()
    tangents = random(4, 4, seed=3), random(4, seed=4)
    ours, exact = kind(solver), reference(kind)
    cotangent = random(4, seed=5)
    close(jvp(ours, given, tangents), jvp(exact, given, tangents))
    close(vjp(ours, *given)[1](cotangent), vjp(exact, *given)[1](cotangent))
    close(
        grad(lambda *g: ours(*g).square().sum(), (0, 1))(*given),
        grad(lambda *g: exact(*g).square().sum(), (0, 1))(*given),
    )
    close(jacrev(ours, (0, 1))(*given), jacrev(exact, (0, 1))(*given))
    close(jacfwd(ours, (0, 1))(*given), jacrev(exact, (0, 1))(*given))


@matrices
@pytest.mark.parametrize("second", SECOND, ids=SECOND_NAMES)
def test_second_derivatives_equal_those_of_lapack(kind, second):
    given = matrix_and_vector()
    ours, exact = (
        lambda *g, f=f: (f(*g) ** 3).sum() for f in (kind(prdp.GMRES(9, restart=4, rtol=1e-14)), reference(kind))
    )
    close(second(ours, (0, 1))(*given), hessian(exact, (0, 1))(*given))


@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node")
def test_linearize_keeps_the_solve_of_the_tangent():
    given = matrix_and_vector()
    u, linear = linearize(dense_solve(prdp.GMRES(9, restart=4, rtol=1e-14)), *given)
    for seed in (3, 4):
        tangents = random(4, 4, seed=seed), random(4, seed=seed + 5)
        close((u, linear(*tangents)), jvp(torch.linalg.solve, given, tangents))


@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node")
@pytest.mark.parametrize("operator", [
    lambda a: operators.Matrix(a.to_sparse_csr()),
    lambda a: operators.Function(lambda v, a: v @ a.mT, lambda v, a: v @ a, (a,)),
    lambda a: a.to_sparse_csr(),
], ids=["csr operator", "function", "csr tensor"])  # fmt: skip
def test_operators_from_outside_of_the_transform(operator):
    a, b = matrix_and_vector()
    product, b = operator(a), b[None]

    def solve(b):
        return prdp.linear_solve(product, b, prdp.GMRES(9, restart=4, rtol=1e-14))[0]

    inverse = torch.linalg.inv(a)
    for jacobian in (jacfwd(solve)(b), jacrev(solve)(b)):
        close(jacobian.reshape(4, 4), inverse)
    if not isinstance(product, torch.Tensor):  # torch does not trace sparse tensors
        close(linearize(solve, b)[1](b), b @ inverse.mT)


@matrices
def test_vmap_takes_a_batch_of_systems_and_their_derivatives(kind):
    ours = kind(prdp.GMRES(9, restart=4, rtol=1e-14))
    a = torch.stack([matrix_and_vector()[0] + k * torch.eye(4) for k in range(3)])
    b = random(3, 4, seed=1)
    for f in (ours, grad(lambda *g: ours(*g).square().sum(), (0, 1)), jacfwd(ours), hessian(lambda *g: ours(*g).sum())):
        one_by_one = [tree_leaves(f(*entry)) for entry in zip(a, b, strict=True)]
        close(vmap(f)(a, b), [torch.stack(entries) for entries in zip(*one_by_one, strict=True)])
        one_by_one = [tree_leaves(f(a[0], entry)) for entry in b]
        close(vmap(f, (None, 1))(a[0], b.mT), [torch.stack(entries) for entries in zip(*one_by_one, strict=True)])


def test_the_implicit_tangent_is_a_solve_of_the_same_budget():
    a, b = spd_matrices(2, 6), random(2, 6, seed=1)
    da, db = spd_matrices(2, 6, seed=4), random(2, 6, seed=5)
    solver = prdp.CG(2, rtol=0.0)
    u, tangent = jvp(dense_solve(solver), (a, b), (da, db))
    rhs = db - (da @ u[..., None])[..., 0]
    close(tangent, dense_solve(solver)(a, rhs))


def test_a_failure_under_vmap_is_reported_per_entry():
    a = operators.Heat((4,), 1e-2, 0.1)
    b = random(3, 2, 1, 4, seed=1)
    b[1, 0, 0, 2] = torch.inf

    def solve(b):
        u, info = prdp.linear_solve(a, b, prdp.CG(9), on_failure="return")
        return u, info.status

    u, status = vmap(solve)(b)
    names = [[prdp.SolveStatus(int(s)).name for s in row] for row in status]
    assert names[1] == ["NONFINITE_INPUT", "CONVERGED"] and names[0] == names[2] == ["CONVERGED"] * 2
    assert torch.isfinite(u).all()


# ---- views in disguise


class Watched(torch.Tensor):
    """A subclass that sees the ops of torch."""

    seen = ()

    @staticmethod
    def __new__(cls, t):
        return torch.Tensor._make_subclass(cls, t)

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        Watched.seen = (*Watched.seen, str(function))
        with torch._C._DisableTorchDispatch():
            return function(*args, **(kwargs or {}))


def test_a_subclass_among_the_tensors_of_the_operator_is_noticed():
    Watched.seen = ()
    a, b = spd_matrices(2, 6), random(2, 6, seed=1)
    u = prdp.linear_solve(Watched(a), b, prdp.CG(20))[0]
    assert "prdp.linear_solve.default" in Watched.seen
    close(u, prdp.linear_solve(a, b, prdp.CG(20))[0], rtol=0, atol=0)


def disguises():
    yield "negative bit", torch._neg_view
    yield "no memory", lambda t: torch._efficientzerotensor(t.shape, dtype=t.dtype)


@pytest.mark.parametrize("disguise", [d[1] for d in disguises()], ids=[d[0] for d in disguises()])
def test_tensors_without_their_values_in_memory(disguise):
    b, a = field((6,)), spd_matrices(2, 6)
    seen = disguise(b)
    plain = torch.zeros_like(b) + seen
    step = prdp.Heat((6,), 1e-2, 0.1, prdp.CG(9))
    assert torch.equal(step(seen), step(plain)) and torch.equal(step.rollout(seen, 2), step.rollout(plain, 2))
    leaf = b.clone().requires_grad_()
    gradients = [torch.autograd.grad(step(leaf), leaf, c)[0] for c in (seen, plain)]
    assert torch.equal(*gradients)
    winds = [prdp.linear_solve(operators.Burgers(w, 1e-2, 0.1), b, prdp.GMRES(9))[0] for w in (seen, plain)]
    assert torch.equal(*winds)
    if disguise is torch._neg_view:
        found = []
        for m in (disguise(-a), a):
            rhs = b[:, 0].clone().requires_grad_()
            u = prdp.linear_solve(m, rhs, prdp.CG(20))[0]
            found.append((u, *torch.autograd.grad(u.square().sum(), rhs)))
        close(found[0], found[1], rtol=0, atol=0)


def advection(winds):
    return operators.Burgers(winds, nu=0.1, dt=0.2)


@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node")  # of linearize
def test_products_have_tangents_in_every_mode():
    winds, u, v = random(2, 1, 9, seed=1), random(2, 1, 9, seed=2), random(2, 1, 9, seed=3)
    for product in (advection(winds).apply, advection(winds).apply_transpose):
        exact = product(v)
        with forward_ad.dual_level():
            close(forward_ad.unpack_dual(product(forward_ad.make_dual(u, v))), (product(u), exact))
        close(jvp(product, (u,), (v,)), (product(u), exact))
        close(linearize(product, u)[1](v), exact)
        close(jacfwd(product)(u), jacrev(product)(u))
        second = jvp(grad(lambda w, of=product: of(w).pow(3).sum()), (u,), (v,))[1]
        other = product.__self__.apply_transpose if product.__name__ == "apply" else product.__self__.apply
        close(second, other(6 * product(u) * exact))
    # A depends on u as well
    moved = jvp(lambda w: advection(w).apply(w), (u,), (v,))[1]
    step = 1e-6
    ahead, behind = (advection(u + s * v).apply(u + s * v) for s in (step, -step))
    close(moved, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-8)


def products():
    """Of each kind of operator, of tensors that may require grad."""
    crow, col = torch.tensor([0, 2, 3, 3]), torch.tensor([2, 0, 1])
    offsets = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
    v, kappa, shift = random(2, 1, 4, 5), random(1, 4, 5, seed=1).exp(), torch.tensor(0.7, dtype=torch.float64)
    yield "diffusion", lambda k, s: operators.Diffusion(k, shift=s), (v, kappa, shift)
    yield "its null space", lambda k: operators.Diffusion(k, boundary="flux"), (v, kappa)
    yield "of each sample", lambda k: operators.Diffusion(k, shift=1.0), (v, random(2, 4, 5, seed=1).exp())
    yield "stencil", lambda c: operators.Stencil(c, offsets, "periodic"), (v, random(1, 5, 4, 5, seed=2))
    yield (
        "burgers",
        lambda w, nu: operators.Burgers(w, nu, 0.2),
        (random(2, 2, 4, 5), random(2, 2, 4, 5, seed=3), shift),
    )
    yield "heat", lambda nu: operators.Heat((4, 5), nu, 0.2), (v, shift)
    yield "dense", operators.Matrix, (random(2, 4), random(4, 4, seed=4))
    yield "csr", lambda x: operators.Matrix.csr(crow, col, x, 3), (random(2, 3), random(3, seed=5))
    yield "csr of each", lambda x: operators.Matrix.csr(crow, col, x, (2, 3, 3)), (random(2, 3), random(2, 3, seed=5))


@pytest.mark.parametrize(("make", "given"), [case[1:] for case in products()], ids=[case[0] for case in products()])
@pytest.mark.parametrize("transposed", [False, True])
def test_products_have_both_derivatives(make, given, transposed):
    def product(v, *tensors):
        a = make(*tensors)
        return a.apply_transpose(v) if transposed else a.apply(v)

    def of_constant(v):
        return product(v, *given[1:])

    inputs = [t.clone().requires_grad_() for t in given]
    forward_over_reverse = not product(*inputs).is_sparse and given[1].dim() > 0
    assert gradcheck(product, inputs)
    assert gradgradcheck(product, inputs, fast_mode=True, check_fwd_over_rev=forward_over_reverse)
    assert gradcheck(of_constant, inputs[:1], check_forward_ad=True)
    assert gradgradcheck(of_constant, inputs[:1], fast_mode=True)
    assert gradcheck(lambda *tensors: product(given[0], *tensors), inputs[1:])  # v is constant
    before = of_constant(inputs[0]).grad_fn.next_functions  # one node
    assert {type(node).__name__ for node, _ in before if node} == {"AccumulateGrad"}


def nested():
    """Products whose operator and vector depend on the same tensor, and the tensor."""
    v, kappa = random(2, 1, 6, seed=1), random(1, 6, seed=2).exp()

    def twice(k):
        a = operators.Diffusion(k, shift=1.0)
        return a.apply(a.apply(v))

    yield "twice", twice, kappa
    yield "of its own", lambda u: operators.Burgers(u, 0.1, 0.1).apply(u), v
    yield "explicit", lambda u: 2 * u - operators.Burgers(u, 0.1, 0.1).apply(u), v
    yield "of each other", lambda k: operators.Diffusion(k, shift=k.mean()).apply(v), kappa
    yield "of a constant", lambda u: operators.Heat((6,), 0.1, 0.1).apply(operators.Heat((6,), 0.2, 0.1).apply(u)), v


@pytest.mark.parametrize(("function", "at"), [case[1:] for case in nested()], ids=[case[0] for case in nested()])
def test_a_recorded_gradient_of_products_is_the_gradient(function, at):
    leaf = at.clone().requires_grad_()
    found = [
        torch.autograd.grad(function(leaf).square().sum(), leaf, create_graph=recorded)[0] for recorded in (False, True)
    ]
    torch.testing.assert_close(found[1], found[0], rtol=1e-12, atol=1e-12)
    close(grad(lambda x: function(x).square().sum())(at), found[0])
    assert gradgradcheck(lambda x: function(x).square().sum(), leaf)


def test_a_product_with_a_constant_takes_what_inference_mode_made():
    with torch.inference_mode():
        kappa = torch.ones(1, 8, dtype=torch.float64)
        a = operators.Diffusion(kappa, shift=1.0)
    v = random(2, 1, 8).requires_grad_()
    a.apply(v).sum().backward()
    close(v.grad, operators.Diffusion(torch.ones(1, 8).double(), shift=1.0).apply(torch.ones_like(v)))
    product = operators.Poisson((8,)).apply(v).sum()
    product.backward(retain_graph=True)
    product.backward()
