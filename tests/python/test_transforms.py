"""torch.func and forward mode through solves, steps and rollouts."""

import pytest
import torch
import torch.autograd.forward_ad as fwad
from helpers import field, spd_matrices
from torch.func import grad, hessian, jacfwd, jacrev, jvp, linearize, vjp, vmap
from torch.utils._pytree import tree_leaves

import prdp_torch as prdp
from prdp_torch import operators

# torch's own forward mode warns when it is first used.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script")
EXACT = {"rtol": 1e-10, "atol": 1e-12}
SECOND = [hessian, lambda f, n: jacrev(jacrev(f, n), n), lambda f, n: jacrev(jacfwd(f, n), n),
          lambda f, n: jacfwd(jacfwd(f, n), n)]  # fmt: skip
SECOND_NAMES = ["forward over reverse", "reverse over reverse", "reverse over forward", "forward over forward"]


def close(found, expected, **tolerance):
    found, expected = tree_leaves(found), tree_leaves(expected)
    assert len(found) == len(expected)
    for f, e in zip(found, expected, strict=True):
        torch.testing.assert_close(f, e, **(tolerance or EXACT))


def random(*shape, seed=1):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def central(f, arguments, tangents, step=1e-6):
    ahead, behind = ([a + s * t for a, t in zip(arguments, tangents, strict=True)] for s in (step, -step))
    return (f(*ahead) - f(*behind)) / (2 * step)


# ---- matrices, against torch.linalg.solve

PATTERN = torch.tensor([[1.0, 1, 0, 0], [0, 1, 1, 0], [1, 0, 1, 0], [0, 1, 0, 1]], dtype=torch.float64).bool()


def dense_solve(solver, backward="implicit"):
    return lambda a, b: prdp.linear_solve(a, b, solver, backward=backward)[0]


def csr_solve(solver, backward="implicit"):
    """By the op, since torch makes no sparse tensors of tensors that it transforms."""
    csr = PATTERN.double().to_sparse_csr()
    crow, col, (row, column) = csr.crow_indices(), csr.col_indices(), PATTERN.nonzero().unbind(1)

    def solve(a, b):
        tensors = [crow, col, a[row, column]]
        options = (solver.method, solver.max_iter, solver.rtol, solver.restart, backward, None, None, "raise", 0)
        return torch.ops.prdp.linear_solve(b[None], tensors, "csr", [], [], False, *options)[0][0]

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
    a = torch.where(PATTERN, 0.4 * random(4, 4), 0.0) + 3 * torch.eye(4, dtype=torch.float64)
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
    b = random(3, 4)
    for f in (ours, grad(lambda *g: ours(*g).square().sum(), (0, 1)), jacfwd(ours), hessian(lambda *g: ours(*g).sum())):
        one_by_one = [tree_leaves(f(*entry)) for entry in zip(a, b, strict=True)]
        close(vmap(f)(a, b), [torch.stack(entries) for entries in zip(*one_by_one, strict=True)])
        one_by_one = [tree_leaves(f(a[0], entry)) for entry in b]
        close(vmap(f, (None, 1))(a[0], b.mT), [torch.stack(entries) for entries in zip(*one_by_one, strict=True)])


# ---- steps and rollouts, against finite differences


def heat(nu, backward):
    return prdp.Heat((5,), nu, 0.1, prdp.CG(9, rtol=1e-14), backward)


def poisson(nu, backward):
    return prdp.Poisson((3, 4), prdp.CG(20, rtol=1e-14), backward)


def burgers(nu, backward):
    return prdp.Burgers((3, 4), nu, 0.1, prdp.GMRES(20, restart=8, rtol=1e-14), backward, picard_steps=2)


def navier_stokes(nu, backward):
    # The Jacobian's cotangents have a mean pressure.
    return prdp.NavierStokes((3, 4), nu, 0.1, prdp.Direct(), backward, on_failure="return")


STEPPERS = [(heat, 1, (5,)), (poisson, 1, (3, 4)), (burgers, 2, (3, 4)), (navier_stokes, 3, (3, 4))]
steppers = pytest.mark.parametrize("make, channels, shape", STEPPERS, ids=[s[0].__name__ for s in STEPPERS])
ways = pytest.mark.parametrize("way", ["step", "rollout"])


def taking(make, way, backward="implicit"):
    def take(u, nu):
        stepper = make(nu, backward)
        return stepper(u) if way == "step" else stepper.rollout(u, 2)

    return take


def state_and_viscosity(channels, shape):
    return field(shape, channels=channels), torch.tensor(1e-2, dtype=torch.float64)


@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node")
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@ways
@steppers
def test_tangents_of_steps_equal_finite_differences(make, channels, shape, way, backward):
    take, given = taking(make, way, backward), state_and_viscosity(channels, shape)
    tangents = field(shape, channels=channels, seed=3), torch.tensor(0.7, dtype=torch.float64)
    expected = central(take, given, tangents)
    tolerance = {"rtol": 1e-7, "atol": 1e-8}
    close(jvp(take, given, tangents)[1], expected, **tolerance)
    close(linearize(take, *given)[1](*tangents), expected, **tolerance)
    with fwad.dual_level():
        duals = [fwad.make_dual(*pair) for pair in zip(given, tangents, strict=True)]
        close(fwad.unpack_dual(take(*duals)).tangent, expected, **tolerance)
    for i in (0, 1):  # one tangent alone
        alone = [t if i == k else torch.zeros_like(t) for k, t in enumerate(tangents)]
        close(jvp(take, given, tuple(alone))[1], central(take, given, alone), **tolerance)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@ways
@steppers
def test_gradients_of_steps_equal_those_of_plain_autograd(make, channels, shape, way, backward):
    take, given = taking(make, way, backward), state_and_viscosity(channels, shape)
    leaves = [g.clone().requires_grad_() for g in given]
    u = take(*leaves)
    leaves = leaves[: 1 if make is poisson else 2]
    cotangents = random(3, *u.shape)
    if make is navier_stokes:
        cotangents[..., 2, :, :] = 0
    plain = [torch.autograd.grad(u, leaves, c, retain_graph=True) for c in cotangents]
    _, pullback = vjp(take, *given)
    for cotangent, expected in zip(cotangents, plain, strict=True):
        close(pullback(cotangent)[: len(leaves)], expected)
    plain = [torch.stack(entries) for entries in zip(*plain, strict=True)]
    close(vmap(pullback)(cotangents)[: len(leaves)], plain)
    close(torch.autograd.grad(u, leaves, cotangents, is_grads_batched=True), plain)
    if backward == "implicit":
        close(jacfwd(take, (0, 1))(*given), jacrev(take, (0, 1))(*given), rtol=1e-8, atol=1e-10)


@ways
@steppers
def test_second_derivatives_of_steps_equal_those_of_plain_autograd(make, channels, shape, way):
    u, nu = state_and_viscosity(channels, shape)
    given = u[:1], nu
    take = taking(make, way)

    def loss(u, nu):
        u = take(u, nu)
        return (u[..., :2, :, :] if make is navier_stokes else u).pow(3).sum()

    along = field(shape, 1, channels=channels, seed=3), torch.tensor(0.7, dtype=torch.float64)
    expected = torch.autograd.functional.hvp(loss, given, along)[1]
    gradient = grad(loss, (0, 1))
    close(jvp(gradient, given, along)[1], expected)
    close(vjp(gradient, *given)[1](along), expected)
    close(grad(lambda *g: jvp(loss, g, along)[1], (0, 1))(*given), expected)
    close(expected, torch.autograd.functional.hvp(loss, given, along)[1])
    ahead, behind = ([gradient(*(g + s * t for g, t in zip(given, along, strict=True)))] for s in (1e-6, -1e-6))
    close(
        [(a - b) / 2e-6 for a, b in zip(tree_leaves(ahead), tree_leaves(behind), strict=True)],
        expected,
        rtol=1e-6,
        atol=1e-6,
    )


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@ways
@steppers
def test_vmap_gives_what_a_loop_gives(make, channels, shape, way, backward):
    take, (_, nu) = taking(make, way, backward), state_and_viscosity(channels, shape)
    u = random(3, 2, channels, *shape)
    viscosities = torch.tensor([1e-2, 2e-2, 0.0], dtype=torch.float64)
    take_gradient = grad(lambda u, nu: take(u, nu)[..., :1, :].square().sum(), (0, 1))
    for f in (take, take_gradient) if make is not navier_stokes else (take,):
        entries = [tree_leaves(f(x, nu)) for x in u]
        close(vmap(f, (0, None))(u, nu), [torch.stack(e) for e in zip(*entries, strict=True)], rtol=0, atol=0)
        entries = [tree_leaves(f(u[0], n)) for n in viscosities]
        close(
            vmap(f, (None, 0))(u[0], viscosities), [torch.stack(e) for e in zip(*entries, strict=True)], rtol=0, atol=0
        )
    nested = vmap(vmap(take, (0, None)), (0, 0))(u.unsqueeze(2).movedim(0, 1), viscosities[:2])
    close(
        nested,
        torch.stack([torch.stack([take(x, n) for x in u.unsqueeze(2)[:, i]]) for i, n in enumerate(viscosities[:2])]),
        rtol=0,
        atol=0,
    )


# ---- what a solve that stops early is differentiated for


@pytest.mark.parametrize("solver", [prdp.Jacobi, prdp.SteepestDescent, prdp.CG, prdp.GMRES, prdp.Chebyshev])
def test_unrolled_tangents_are_those_of_the_iterations_that_ran(solver):
    def take(u, nu):
        return prdp.Heat((6,), nu, 0.1, solver(2, rtol=0.0), "unrolled")(u)

    given = field((6,)), torch.tensor(0.3, dtype=torch.float64)
    tangents = field((6,), seed=3), torch.tensor(0.7, dtype=torch.float64)
    tangent = jvp(take, given, tangents)[1]
    close(tangent, central(take, given, tangents), rtol=1e-7, atol=1e-8)
    cotangent = field((6,), seed=4)
    gradients = vjp(take, *given)[1](cotangent)
    along = sum((g * t).sum() for g, t in zip(gradients, tangents, strict=True))
    close((tangent * cotangent).sum(), along)


def test_the_implicit_tangent_is_a_solve_of_the_same_budget():
    a, b = spd_matrices(2, 6), random(2, 6)
    da, db = spd_matrices(2, 6, seed=4), random(2, 6, seed=5)
    solver = prdp.CG(2, rtol=0.0)
    u, tangent = jvp(dense_solve(solver), (a, b), (da, db))
    rhs = db - (da @ u[..., None])[..., 0]
    close(tangent, dense_solve(solver)(a, rhs))


# ---- words instead of wrong numbers


@pytest.mark.parametrize("second", SECOND, ids=SECOND_NAMES)
def test_second_derivatives_of_unrolled_solves_are_refused(second):
    step = prdp.Heat((4,), 1e-2, 0.1, prdp.Jacobi(3), "unrolled")
    with pytest.raises(RuntimeError, match="no second derivatives"):
        second(lambda u: step(u).pow(3).sum(), 0)(field((4,), 1))


def test_without_a_backward_mode_there_is_no_derivative_in_any_direction():
    step, u = prdp.Heat((4,), 1e-2, 0.1, prdp.Jacobi(3), "none"), field((4,))
    assert not jvp(step, (u,), (u,))[1].any() and not grad(lambda u: step(u).sum())(u).any()


def test_a_tangent_that_is_not_finite_names_its_sample():
    step, u = prdp.Heat((4,), 1e-2, 0.1, prdp.Jacobi(3)), field((4,))
    tangent = torch.ones_like(u)
    tangent[1, 0, 2] = torch.nan
    with pytest.raises(torch.linalg.LinAlgError, match="sample 1 NONFINITE_INPUT"):
        jvp(step, (u,), (tangent,))


def test_a_refused_sample_has_no_tangent():
    step, u = prdp.Heat((4,), 1e-2, 0.1, prdp.Jacobi(3), on_failure="return"), field((4,), 3)
    expected = step(torch.ones_like(u))
    u[1, 0, 2] = torch.nan
    _, tangent = jvp(step, (u,), (torch.ones_like(u),))
    assert not tangent[1].any()
    close(tangent[[0, 2]], expected[[0, 2]], rtol=0, atol=0)


# ---- reports, and torch.compile


def test_reports_outlive_the_transforms():
    step, u = prdp.Heat((4,), 1e-2, 0.1, prdp.CG(9)), random(3, 2, 1, 4)
    vmap(step)(u)
    assert step.info.status.shape == (3, 2) and step.converged and "6 CONVERGED" in repr(step.info)
    vmap(jacfwd(step))(u)
    assert step.info.status.shape == (3, 2) and step.converged
    jacrev(lambda u: step.rollout(u, 5))(u[0])
    assert step.info.iterations.shape == (2, 5) and step.converged

    def counted(b):
        u, info = prdp.linear_solve(operators.Heat((4,), 1e-2, 0.1), b, prdp.CG(9))
        return u, info.iterations

    assert vmap(counted)(u)[1].shape == (3, 2)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_transforms_compile(backward):
    step, u = heat(0.1, backward), field((5,), 3)
    for f in (grad(lambda u: step(u).pow(3).sum()), vmap(lambda u: step(u[None])), lambda u: jvp(step, (u,), (u,))):
        torch._dynamo.reset()
        close(torch.compile(f, fullgraph=True, backend="aot_eager")(u), f(u), rtol=0, atol=1e-15)


def test_a_failure_under_vmap_is_reported_per_entry():
    a = operators.Heat((4,), 1e-2, 0.1)
    b = random(3, 2, 1, 4)
    b[1, 0, 0, 2] = torch.inf

    def solve(b):
        u, info = prdp.linear_solve(a, b, prdp.CG(9), on_failure="return")
        return u, info.status

    u, status = vmap(solve)(b)
    names = [[prdp.SolveStatus(int(s)).name for s in row] for row in status]
    assert names[1] == ["NONFINITE_INPUT", "CONVERGED"] and names[0] == names[2] == ["CONVERGED"] * 2
    assert torch.isfinite(u).all()


def test_a_bad_viscosity_is_refused_under_vmap_too():
    u = field((5,))
    with pytest.raises(ValueError, match="nu must be finite and >= 0"):
        vmap(lambda nu: heat(nu, "implicit")(u))(torch.tensor([0.1, -0.1], dtype=torch.float64))


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
    a, b = spd_matrices(2, 6), random(2, 6)
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
