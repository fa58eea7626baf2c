"""on_failure="zero_grad": a failed sample hands out its value and no gradient, and the others keep theirs."""

import pytest
import torch
from helpers import field, golden, modes, statuses
from torch.func import grad, jvp, vmap

import prdp_torch as prdp
from prdp_torch import fields, operators

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script")
F = golden("failures")
DIVERGES = torch.tensor(F["A07__A"])  # under Jacobi
FINE = torch.tensor([[3.0, 1.0, 0.0], [1.0, 4.0, -1.0], [0.5, 0.0, 2.0]], dtype=torch.float64)
SWAP = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def leaf(t):
    return t.clone().requires_grad_()


def flow(batch=3, bad=None):
    """Right-hand sides for a Navier-Stokes operator; the pressure of sample `bad` has a mean, which no flow has."""
    b = field((4, 4), batch=batch, channels=3)
    b[:, 2] -= b[:, 2].mean((1, 2), keepdim=True)
    if bad is not None:
        b[bad, 2] += 1.0
    return b


def cases():
    """(status of sample 1, make the operator from the numbers of the samples and tensors, tensors that all samples
    share, tensors of the samples, b, solver)."""
    b = torch.tensor([[1.0, 2.0, 3.0], [1.0, 0.0, 0.0], [-1.0, 0.5, 2.0]], dtype=torch.float64)
    nan = b.clone()
    nan[1, 2] = float("nan")
    matrices = torch.stack([FINE, DIVERGES, FINE.mT.contiguous()])
    swapped = torch.stack([FINE, SWAP, FINE.mT.contiguous()])
    inf = matrices.clone()
    inf[1, 0, 1] = float("inf")
    winds = 0.1 * field((8,), batch=3, seed=3)
    bad_winds = winds.clone()
    bad_winds[1, 0, 2] = float("nan")
    coefficients = torch.tensor([3.0, -1.0, -0.5], dtype=torch.float64).view(1, 3, 1).expand(3, 3, 8).clone()
    coefficients[1, 0] = 0.0
    nu = torch.tensor(0.02, dtype=torch.float64)
    velocity, grid = 0.1 * field((4, 4), batch=3, channels=3, seed=4), field((8,), batch=3)
    nan_grid = grid.clone()
    nan_grid[1, 0, 0] = float("inf")

    def burgers(w, nu):
        return operators.Burgers(w, nu, 0.05)

    def navier_stokes(w, nu):
        return operators.NavierStokes(w, nu, 0.05)

    def stencil(c):
        return operators.Stencil(c, [(0,), (-1,), (1,)])

    def function(k):
        return operators.Function(lambda v, k: v @ k.mT, lambda v, k: v @ k, tensors=(k,))

    def shared(a):
        return a

    return {
        "diverged": ("DIVERGED", shared, [matrices], [], b, prdp.Jacobi(500)),
        "breakdown": ("BREAKDOWN", shared, [swapped], [], b, prdp.SteepestDescent(200)),
        "zero diagonal": ("ZERO_DIAGONAL", shared, [swapped], [], b, prdp.Jacobi(100)),
        "infinite matrix": ("NONFINITE_OPERATOR", shared, [inf], [], b, prdp.GMRES(5, restart=3)),
        "NaN": ("NONFINITE_INPUT", shared, [], [FINE], nan, prdp.GMRES(5, restart=3)),
        "NaN, exact": ("NONFINITE_INPUT", shared, [], [FINE], nan, prdp.Direct()),
        "NaN, function": ("NONFINITE_INPUT", function, [], [FINE], nan, prdp.GMRES(5, restart=3)),
        "overflow": ("OVERFLOW", shared, [], [0.1 * FINE.float()], b.float() * torch.tensor([[1.0], [3e38], [1.0]]),
                     prdp.GMRES(5, restart=3)),
        "infinite state": ("NONFINITE_INPUT", burgers, [winds], [nu], nan_grid, prdp.Jacobi(40)),
        "NaN in the winds": ("NONFINITE_OPERATOR", burgers, [bad_winds], [nu], grid, prdp.Jacobi(40)),
        "inconsistent": ("INCONSISTENT", navier_stokes, [velocity], [nu], flow(bad=1), prdp.GMRES(9, restart=8)),
        "stencil": ("ZERO_DIAGONAL", stencil, [coefficients], [], grid, prdp.Jacobi(60)),
    }  # fmt: skip


CASES = cases()


def gradients(make, of_samples, shared, b, solver, backward, on_failure):
    """u, its report, and the gradients of b and of the tensors, for a cotangent of no structure."""
    of_samples, shared, b = [leaf(t) for t in of_samples], [leaf(t) for t in shared], leaf(b)
    u, info = prdp.linear_solve(make(*of_samples, *shared), b, solver, backward=backward, on_failure=on_failure)
    cotangent = torch.linspace(1.0, 20.0, u[0].numel(), dtype=u.dtype).view_as(u[0]).sin()
    if u.dim() == 4:  # a step leaves the mean of the pressure free
        cotangent = cotangent - cotangent.mean((1, 2), keepdim=True)
    u.backward(cotangent.expand_as(u))
    return u.detach(), info, b.grad, [t.grad for t in of_samples], [t.grad for t in shared]


@modes
@pytest.mark.parametrize("case", CASES)
def test_the_gradient_is_that_of_the_healthy_samples_alone(case, backward):
    status, make, of_samples, shared, b, solver = CASES[case]
    u, info, b_bar, bars, shared_bars = gradients(make, of_samples, shared, b, solver, backward, "zero_grad")
    returned = prdp.linear_solve(make(*of_samples, *shared), b, solver, on_failure="return")
    assert statuses(info)[1] == status and info.failed.tolist() == [False, True, False]
    assert torch.equal(u, returned[0]) and torch.equal(info.status, returned[1].status)

    rest = torch.tensor([0, 2])
    alone = gradients(make, [t[rest] for t in of_samples], shared, b[rest], solver, backward, "raise")
    assert torch.equal(b_bar[rest], alone[2]) and not b_bar[1].any()
    for bar, expected in zip(bars, alone[3], strict=True):
        assert torch.equal(bar[rest], expected) and expected.any() and not bar[1].any()
    for bar, expected in zip(shared_bars, alone[4], strict=True):
        torch.testing.assert_close(bar, expected, rtol=1e-12 if b.dtype == torch.float64 else 1e-6, atol=0.0)
        assert expected.any()


@modes
def test_return_hands_out_another_gradient_where_zero_grad_hands_out_none(backward):
    _, make, of_samples, shared, b, solver = CASES["inconsistent"]
    found = {way: gradients(make, of_samples, shared, b, solver, backward, way) for way in ("return", "zero_grad")}
    assert found["return"][2][1].any() and not found["zero_grad"][2][1].any()


@modes
def test_a_failed_adjoint_solve_gives_no_gradient_either(backward):
    """A = ones is singular: b = (1, 1) lies in its range, the cotangent (1, 0) does not."""
    a = torch.stack([torch.eye(2) * 2.0, torch.ones(2, 2), torch.tensor([[2.0, 1.0], [0.0, 1.0]])]).double()
    cotangent = torch.tensor([[1.0, 2.0], [1.0, 0.0], [1.0, -1.0]], dtype=torch.float64)
    found = {}
    for way in ("return", "zero_grad"):
        matrix, b = leaf(a), leaf(torch.ones(3, 2, dtype=torch.float64))
        u, info = prdp.linear_solve(matrix, b, prdp.GMRES(20, restart=2), backward=backward, on_failure=way)
        assert not info.failed.any()
        u.backward(cotangent)
        assert info.adjoint.failed.tolist() == [False, True, False] and statuses(info.adjoint)[1] == "BREAKDOWN"
        found[way] = b.grad, matrix.grad
    for returned, zeroed in zip(found["return"], found["zero_grad"], strict=True):
        assert returned[1].any() and not zeroed[1].any()
        assert torch.equal(returned[::2], zeroed[::2]) and zeroed[0].any()


@modes
def test_a_cotangent_of_nan_takes_no_other_sample_with_it(backward):
    w, nu = 0.1 * field((8,), batch=3, seed=3), leaf(torch.tensor(0.02, dtype=torch.float64))
    step = prdp.Burgers((8,), nu, 0.05, prdp.Jacobi(40), backward=backward, on_failure="zero_grad")
    u = leaf(w)
    cotangent = torch.ones_like(w)
    cotangent[1, 0, 3] = float("nan")
    step(u).backward(cotangent)
    healthy, nu_alone = leaf(w[::2]), leaf(nu.detach())
    alone = prdp.Burgers((8,), nu_alone, 0.05, prdp.Jacobi(40), backward=backward)
    alone(healthy).backward(cotangent[::2])
    assert torch.equal(u.grad[::2], healthy.grad) and not u.grad[1].any()
    torch.testing.assert_close(nu.grad, nu_alone.grad, rtol=1e-12, atol=0.0)


# ---- rollouts


def wild(nu, backward, picard_steps=1, on_failure="zero_grad"):
    """Steepest descent does not fit the flow: some samples blow up, in some steps."""
    options = {"backward": backward, "picard_steps": picard_steps, "on_failure": on_failure, "adjoint_max_iter": 20}
    return prdp.NavierStokes((4, 4), nu, 0.1, prdp.SteepestDescent(300, rtol=0.0), **options)


def states_at_first():
    return 2.0 * fields.project(field((4, 4), batch=8, dtype=torch.float32, channels=3)).double()


def rolled_out(stepper, u0, steps, fused, weights=None):
    u0, nu = leaf(u0), stepper.nu
    nu.grad = None
    if fused:
        states, status = stepper.rollout(u0, steps), stepper.info.status
    else:
        row, reports = [u0], []
        for _ in range(steps):
            row.append(stepper(row[-1]))
            reports.append(stepper.info.status)
        states, status = torch.stack(row, 1), torch.stack(reports, 1)
    weights = torch.ones(steps + 1, dtype=u0.dtype) if weights is None else weights
    (states[:, :, :2].sin() * weights.view(1, -1, 1, 1, 1)).sum().backward()  # not of the pressure's mean
    return states.detach(), status, u0.grad, nu.grad


@modes
@pytest.mark.parametrize("picard_steps", [1, 2])
def test_a_rollout_passes_no_gradient_through_a_failed_step(backward, picard_steps):
    u0, steps = states_at_first(), 6
    stepper = wild(torch.nn.Parameter(torch.tensor(1e-3, dtype=torch.float64)), backward, picard_steps)
    last = torch.zeros(steps + 1, dtype=torch.float64)
    last[-1] = 1.0
    states, status, u_bar, nu_bar = rolled_out(stepper, u0, steps, True, last)
    failed = (status < prdp.SolveStatus.STAGNATED).any(1)
    assert failed.any() and not failed.all()
    assert not u_bar[failed].any() and (u_bar[~failed] != 0).flatten(1).any(1).all()
    one_by_one = rolled_out(stepper, u0, steps, False, last)
    for fused, chained in zip((states, status, u_bar, nu_bar), one_by_one, strict=True):
        torch.testing.assert_close(fused, chained, rtol=1e-12, atol=0.0)
    healthy = rolled_out(stepper, u0[~failed], steps, True, last)
    assert torch.equal(u_bar[~failed], healthy[2])


@modes
def test_detach_failed_leaves_the_healthy_samples_of_a_rollout_alone(backward):
    u0, steps = states_at_first(), 6
    nu = torch.nn.Parameter(torch.tensor(1e-3, dtype=torch.float64))
    stepper = wild(nu, backward)
    states = stepper.rollout(u0, steps)
    failed = stepper.info.failed.any(1)
    held = prdp.detach_failed(states, stepper.info)
    assert torch.equal(held, states)
    held[:, -1, :2].sin().sum().backward()
    found, nu.grad = nu.grad, None
    stepper.rollout(u0[~failed], steps)[:, -1, :2].sin().sum().backward()
    torch.testing.assert_close(found, nu.grad, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("on_failure", ["zero_grad", "return"])
@pytest.mark.parametrize("part", ["rhs", "operator"])
@pytest.mark.parametrize("steps", [1, 3])
def test_an_infinite_derivative_of_the_parts_of_a_step_reaches_no_weight(part, steps, on_failure):
    """The zero cotangent of a refused sample, times the derivative of exp(u) = Inf, is NaN in what made its state."""
    torch.manual_seed(0)
    network = torch.nn.Linear(16, 16).double()
    x = torch.randn(4, 1, 16, dtype=torch.float64)
    x[2] *= 1e5
    if part == "rhs":
        a, rhs = operators.Heat((16,), 1e-2, 0.1), lambda u: u + 0.1 * torch.exp(u)
    else:
        a, rhs = (lambda u: operators.Diffusion(torch.exp(u[:, 0]), 1.0)), None
    step = prdp.ImplicitStep(a, rhs, prdp.CG(400), on_failure=on_failure)

    def gradient(rows):
        network.zero_grad()
        states = step.rollout(network(x[rows]), steps)[:, 1:]
        (states * torch.tensor([[0.0] if r == 2 else [1.0] for r in rows])[..., None, None]).square().sum().backward()
        return network.weight.grad

    found = gradient([0, 1, 2, 3])
    assert step.info.failed[2].any() and not step.info.failed[[0, 1, 3]].any()
    torch.testing.assert_close(found, gradient([0, 1, 3]), rtol=1e-6, atol=1e-9)


def test_detach_failed_checks_its_shapes():
    heat = prdp.Heat((5,), 1e-3, 1.0, prdp.Jacobi(3))
    u = heat(field((5,)))
    assert prdp.detach_failed(u, heat.info) is u
    with pytest.raises(ValueError, match=r"detach_failed: u of shape \[3, 1, 5\] does not fit a status of shape \[2\]"):
        prdp.detach_failed(field((5,), batch=3), heat.info)
    heat.rollout(field((5,)), 3)
    with pytest.raises(ValueError, match=r"does not fit a status of shape \[2, 3\]"):
        prdp.detach_failed(field((5,)), heat.info)


# ---- transforms


@modes
def test_under_vmap_and_grad(backward):
    matrices = torch.stack([FINE, DIVERGES, FINE.mT.contiguous()])
    b = torch.tensor([[1.0, 2.0, 3.0], [1.0, 0.0, 0.0], [-1.0, 0.5, 2.0]], dtype=torch.float64)

    def loss(a, b):
        return prdp.linear_solve(a, b, prdp.Jacobi(500), backward, on_failure="zero_grad")[0].sin().sum()

    found = vmap(grad(loss, argnums=(0, 1)))(matrices, b)
    for t in found:
        assert torch.isfinite(t).all() and not t[1].any() and t[0].any() and t[2].any()
    for i in (0, 2):
        a_bar, b_bar = torch.autograd.grad(loss(ma := leaf(matrices[i]), bi := leaf(b[i])), (ma, bi))
        torch.testing.assert_close(found[0][i], a_bar)
        torch.testing.assert_close(found[1][i], b_bar)


@modes
def test_a_failed_sample_has_no_tangent(backward):
    matrices = torch.stack([FINE, DIVERGES])
    b = torch.tensor([[1.0, 2.0, 3.0], [1.0, 0.0, 0.0]], dtype=torch.float64)

    def solve(a, b):
        return prdp.linear_solve(a, b, prdp.Jacobi(500), backward, on_failure="zero_grad")[0]

    _, tangent = jvp(solve, (matrices, b), (torch.ones_like(matrices), torch.ones_like(b)))
    assert tangent[0].any() and not tangent[1].any()


def test_second_derivatives_of_a_failed_sample_are_zero():
    b = leaf(torch.tensor([[1.0, 2.0, 3.0], [1.0, 0.0, 0.0]], dtype=torch.float64))
    a = leaf(torch.stack([FINE, DIVERGES]))
    u, _ = prdp.linear_solve(a, b, prdp.Jacobi(500, rtol=1e-12), on_failure="zero_grad")
    (first,) = torch.autograd.grad(u.sin().sum(), a, create_graph=True)
    second = torch.autograd.grad(first.sin().sum(), (a, b))
    for t in (first, *second):
        assert torch.isfinite(t).all() and t[0].any() and not t[1].any()


def test_it_compiles():
    nu = torch.nn.Parameter(torch.tensor(1e-3, dtype=torch.float64))
    step = prdp.NavierStokes((4, 4), nu, 0.1, prdp.GMRES(9, restart=8), on_failure="zero_grad")
    b = field((4, 4), batch=3, channels=3)
    b[1, 0, 0, 0] = float("nan")

    def loss(u):
        return (2.0 * prdp.detach_failed(step(u), step.info))[:, :2].sin().sum()

    grads = []
    for f in (loss, torch.compile(loss, backend="aot_eager", fullgraph=True)):
        u, nu.grad = leaf(b), None
        f(u).backward()
        grads.append((u.grad, nu.grad))
    for eager, compiled in zip(*grads, strict=True):
        torch.testing.assert_close(eager, compiled)
    assert not grads[0][0][1].any() and grads[0][0][0].any() and torch.isfinite(grads[0][1])


def of_field(v, k):
    return 4 * v * k.sqrt() - 0.5 * (v.roll(1, -1) + v.roll(-1, -1))


FIELDS = {  # operators of a field with one row per sample
    "diffusion": lambda k: operators.Diffusion(k[:, 0], shift=1.0, boundary="flux"),
    "function": lambda k: operators.Function(
        of_field, tensors=[k], symmetric=True, diagonal=lambda k: (4 * k.sqrt()).expand_as(k)
    ),
}


@pytest.mark.parametrize("on_failure", ["zero_grad", "return"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize(
    "solver", [prdp.Jacobi(60), prdp.CG(60), prdp.GMRES(9, restart=9), prdp.BiCGStab(30), prdp.Direct()]
)
@pytest.mark.parametrize("name", FIELDS)
def test_a_field_that_is_not_finite_leaves_the_others_their_gradients(name, solver, backward, bad, on_failure):
    """The derivative of the field's sample is NaN whatever λ, and all of them were lost with it."""
    generator = torch.Generator().manual_seed(4)
    field = torch.rand(3, 1, 12, generator=generator, dtype=torch.float64) + 0.5
    field[1, 0, 2] = bad
    loads = torch.randn(3, 1, 12, generator=generator, dtype=torch.float64)
    found = []
    for rows in ([0, 1, 2], [0, 2]):
        k, b = (t[rows].clone().requires_grad_() for t in (field, loads))
        u, _ = prdp.linear_solve(FIELDS[name](k), b, solver, backward=backward, on_failure=on_failure)
        found.append(torch.autograd.grad(u[:, :, 3:].square().sum(), (b, k)))
    for all_of_them, healthy in zip(*found, strict=True):
        assert (healthy != 0).any() and (all_of_them[1] == 0).all()
        torch.testing.assert_close(all_of_them[[0, 2]], healthy, rtol=1e-9, atol=1e-12)
