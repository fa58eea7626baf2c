"""torch.func and forward mode through steps and rollouts, against finite differences and plain autograd."""

import pytest
import torch
import torch.autograd.forward_ad as fwad
from helpers import field, random
from torch.func import grad, jacfwd, jacrev, jvp, linearize, vjp, vmap
from torch.utils._pytree import tree_leaves
from transforms import SECOND, SECOND_NAMES, close

import prdp_torch as prdp
from prdp_torch import operators

# torch's own forward mode warns when it is first used.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script")


def central(f, arguments, tangents, step=1e-6):
    ahead, behind = ([a + s * t for a, t in zip(arguments, tangents, strict=True)] for s in (step, -step))
    return (f(*ahead) - f(*behind)) / (2 * step)


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
    cotangents = random(3, *u.shape, seed=1)
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
    u = random(3, 2, channels, *shape, seed=1)
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
    step, u = prdp.Heat((4,), 1e-2, 0.1, prdp.CG(9)), random(3, 2, 1, 4, seed=1)
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


def test_a_bad_viscosity_is_refused_under_vmap_too():
    u = field((5,))
    with pytest.raises(ValueError, match="nu must be finite and >= 0"):
        vmap(lambda nu: heat(nu, "implicit")(u))(torch.tensor([0.1, -0.1], dtype=torch.float64))


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_vmap_over_an_axis_without_entries(backward):
    """As torch's own operations: the shapes of the entries with a zero in front."""
    none, nus = torch.randn(0, 4, 1, 6), torch.rand(0)
    state, matrices = torch.randn(4, 1, 6), torch.randn(0, 6, 6)

    def step(u, nu):
        return prdp.Heat((6,), nu, 1.0, prdp.CG(3), backward)(u)

    def loss(u, nu):
        return step(u, nu).sum()

    def solve(a, b):
        return prdp.linear_solve(a, b, prdp.CG(3), backward=backward)[0]

    assert vmap(lambda u: step(u, 1e-3))(none).shape == (0, 4, 1, 6)
    assert vmap(lambda nu: step(state, nu))(nus).shape == (0, 4, 1, 6)
    assert vmap(grad(lambda nu: loss(state, nu)))(nus).shape == (0,)
    assert [g.shape for g in vmap(grad(loss, (0, 1)))(none, nus)] == [(0, 4, 1, 6), (0,)]
    assert vmap(solve)(matrices, none[:, :, 0]).shape == (0, 4, 6)
    scaled = vmap(lambda k, b: solve(prdp.operators.Function(lambda v, k: k * v, tensors=(k,)), b))
    assert scaled(matrices[:, 0], none[:, :, 0]).shape == (0, 4, 6)
