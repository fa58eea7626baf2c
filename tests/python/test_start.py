"""Where solves start: x0 of linear_solve, and start="state" of steppers."""

import numpy as np
import pytest
import torch
from helpers import (
    dense_burgers,
    dense_heat,
    dense_laplacian,
    dense_navier_stokes,
    field,
    spd_matrices,
    statuses,
    written,
)
from torch.library import opcheck

import prdp_torch as prdp
from prdp_torch import _C, operators
from prdp_torch.experiments import scenes

modes = pytest.mark.parametrize("backward", ["implicit", "unrolled"])
SYMMETRIC = [prdp.Jacobi, prdp.Chebyshev, prdp.SteepestDescent, prdp.CG, prdp.GMRES]
GENERAL = [prdp.Jacobi, prdp.SteepestDescent, prdp.GMRES]


def laplacian_stencil(n):
    coefficients = torch.stack([torch.full((n,), c, dtype=torch.float64) for c in (3.0, -1.0, -1.0)])
    return operators.Stencil(coefficients[None], [(0,), (-1,), (1,)], "zero")


def matrices():
    """name: (operator, its matrices (batch or 1, n, n), shape of a right-hand side, methods)."""
    spd, winds = spd_matrices(3, 6), 0.3 * field((8,), 3, 1)
    winds2, flow = 0.1 * field((4, 5), 3, 1, channels=2), 0.1 * field((4, 5), 3, 1, channels=3)
    own = operators.Function(
        lambda v: torch.einsum("bij,bj->bi", spd, v), diagonal=lambda: spd.diagonal(dim1=1, dim2=2)
    )
    stacked = [np.stack([dense(w.numpy(), 1e-2, 0.1) for w in of]) for dense, of in
               ((dense_burgers, winds), (dense_burgers, winds2), (dense_navier_stokes, flow))]  # fmt: skip
    return {
        "poisson": (operators.Poisson((9,)), dense_laplacian((9,))[None], (1, 9), SYMMETRIC),
        "heat_2d": (operators.Heat((4, 5), 1e-2, 1.0), dense_heat((4, 5), 1e-2)[None], (1, 4, 5), SYMMETRIC),
        "stencil": (laplacian_stencil(7), 3 * np.eye(7)[None] - np.eye(7, k=1) - np.eye(7, k=-1), (1, 7), GENERAL),
        "dense": (operators.Matrix(spd), spd.numpy(), (6,), [*GENERAL, prdp.CG]),
        "csr": (operators.Matrix(spd[0].to_sparse_csr()), spd[:1].numpy(), (6,), [*GENERAL, prdp.CG]),
        "function": (own, spd.numpy(), (6,), [*GENERAL, prdp.CG]),
        "burgers_1d": (operators.Burgers(winds, 1e-2, 0.1), stacked[0], (1, 8), GENERAL),
        "burgers_2d": (operators.Burgers(winds2, 1e-2, 0.1), stacked[1], (2, 4, 5), GENERAL),
        "navier_stokes": (operators.NavierStokes(flow, 1e-2, 0.1), stacked[2], (3, 4, 5), [prdp.GMRES]),
    }


CASES = [(name, method) for name, (*_, methods) in matrices().items() for method in methods]


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(seed))


def problem(name, seed=0):
    """operator, matrices as (3, n, n), b within the range of A, its exact solution."""
    a, dense, shape, _ = matrices()[name]
    b = random(3, *shape, seed=seed)
    if name == "navier_stokes":
        b[:, 2] -= b[:, 2].mean((1, 2), keepdim=True)
    dense = np.broadcast_to(dense, (3, *dense.shape[1:]))
    exact = [np.linalg.lstsq(m, r, rcond=1e-12)[0] for m, r in zip(dense, b.reshape(3, -1).numpy(), strict=True)]
    return a, dense, b, torch.from_numpy(np.stack(exact)).reshape(b.shape)


def residuals(dense, u, b):
    """‖b - A u‖ / ‖b‖ by numpy."""
    r = b.reshape(3, -1).numpy() - np.einsum("bij,bj->bi", dense, u.detach().reshape(3, -1).numpy())
    return np.linalg.norm(r, axis=1) / np.linalg.norm(b.reshape(3, -1).numpy(), axis=1)


def scaled_start(dense, x0, b):
    """α x0 with the α of least squares, by numpy."""
    rows = []
    for m, x, r in zip(dense, x0.reshape(3, -1).numpy(), b.reshape(3, -1).numpy(), strict=True):
        rows.append(np.linalg.lstsq((m @ x)[:, None], r, rcond=None)[0][0] * x)
    return torch.from_numpy(np.stack(rows)).reshape(x0.shape)


# ---- what is solved


@pytest.mark.parametrize("name, method", CASES)
def test_a_started_solve_meets_its_tolerance_and_saves_iterations(name, method):
    a, dense, b, exact = problem(name)
    solver = method(10_000, rtol=1e-9)
    near = -7.0 * (exact + 1e-6 * random(*b.shape, seed=1))
    u, info = prdp.linear_solve(a, b, solver, x0=near)
    from_zero = prdp.linear_solve(a, b, solver)[1]
    assert (info.status > 0).all()
    assert (residuals(dense, u, b) <= 1e-9 * (1 + 1e-6)).all()
    np.testing.assert_allclose(info.residual, residuals(dense, u, b), rtol=1e-3, atol=1e-13)
    assert (info.iterations <= from_zero.iterations).all()
    if method not in (prdp.CG, prdp.GMRES):  # which solve these few unknowns in few iterations anyway
        assert (info.operator_applications < from_zero.operator_applications).all()
    torch.testing.assert_close(u, exact, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name, method", CASES)
def test_without_iterations_u_is_the_scaled_start_and_no_worse_than_zero(name, method):
    a, dense, b, exact = problem(name)
    for seed in range(5):
        x0 = 10.0 ** (3 * seed - 6) * (random(*b.shape, seed=seed + 1) + (seed % 2) * exact)
        u, info = prdp.linear_solve(a, b, method(0), x0=x0)
        expected = residuals(dense, scaled_start(dense, x0, b), b)
        np.testing.assert_allclose(residuals(dense, u, b), expected, rtol=1e-9)
        np.testing.assert_allclose(info.residual, expected, rtol=1e-6)
        assert (info.residual <= 1).all() and info.iterations.tolist() == [0] * 3


@pytest.mark.parametrize("name, method", CASES)
def test_the_loops_and_plain_tensors_agree(name, method):
    a, _, b, exact = problem(name)
    x0 = exact + random(*b.shape, seed=3) * torch.tensor([0.0, 1e-2, 1.0]).view(3, *[1] * (b.dim() - 1))
    for k, rtol in ((3, 0.0), (300, 1e-7)):
        solver = method(k, rtol=rtol)
        u, info = prdp.linear_solve(a, b, solver, x0=x0, on_failure="return")
        v, said = _C.solve_with_tensors(
            b, a.tensors, a.kind, a.shape, a.parameters, False, solver.method, k, rtol, solver.restart, x0
        )
        torch.testing.assert_close(u, v, rtol=1e-8, atol=1e-10)
        said = prdp.SolveInfo(*said)
        assert info.status.tolist() == said.status.tolist()
        assert info.iterations.tolist() == said.iterations.tolist()
        if method is not prdp.GMRES:  # whose last cycle may be shorter in the loops
            assert info.operator_applications.tolist() == said.operator_applications.tolist()


@pytest.mark.parametrize("name, method", CASES)
def test_an_exact_start_takes_no_iterations(name, method):
    a, dense, b, exact = problem(name)
    u, info = prdp.linear_solve(a, b, method(20, rtol=1e-8), x0=4 * exact)
    assert info.iterations.tolist() == [0] * 3 and statuses(info) == ["CONVERGED"] * 3
    assert (residuals(dense, u, b) <= 1e-8).all()
    assert info.operator_applications.tolist() == [2] * 3  # the scaling, and the residual that is reported


@pytest.mark.parametrize("method", [*SYMMETRIC, prdp.Direct])
def test_a_start_of_zeros_is_none_and_direct_takes_none(method):
    a, b = operators.Heat((20,), 1e-3, 1.0), field((20,), 3, dtype=torch.float32)
    x0 = field((20,), 3, 1) if method is prdp.Direct else torch.zeros(3, 1, 20)
    expected, found = (prdp.linear_solve(a, b, method(5), x0=x) for x in (None, x0.float()))
    assert torch.equal(expected[0], found[0])
    for one, other in zip(expected[1][:4], found[1][:4], strict=True):
        assert torch.equal(one, other)


def test_b_of_zero_is_solved_by_zero_and_a_start_in_the_null_space_is_none():
    a, b = operators.Heat((20,), 1e-3, 1.0), torch.zeros(1, 1, 20)
    u, info = prdp.linear_solve(a, b, prdp.CG(5), x0=torch.ones(1, 1, 20))
    assert torch.equal(u, b) and info.iterations.tolist() == [0] and statuses(info) == ["CONVERGED"]
    flow, _, b, _ = problem("navier_stokes")
    pressure = torch.zeros_like(b)
    pressure[:, 2] = 1.0
    expected, found = (prdp.linear_solve(flow, b, prdp.GMRES(2), x0=x) for x in (None, pressure))
    assert torch.equal(expected[0], found[0])


def test_rtol_is_relative_to_b_where_little_is_left_of_it():
    """In float32 a start good to 1e-5 leaves nothing that could fall by another 1e-5."""
    a = operators.Heat((30,), 1e-3, 1.0)
    b = field((30,), 4, dtype=torch.float32)
    near = prdp.linear_solve(a, b, prdp.Direct())[0] * (1 + 1e-4 * field((30,), 4, 1, dtype=torch.float32))
    for method in SYMMETRIC:
        info = prdp.linear_solve(a, b, method(200, rtol=1e-5), x0=near)[1]
        assert statuses(info) == ["CONVERGED"] * 4 and (info.residual <= 1e-5).all()


# ---- guarantees


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", SYMMETRIC)
def test_powers_of_two_pass_through_exactly(method, dtype):
    a, b, x0 = operators.Heat((12,), 1e-3, 1.0), field((12,), 2, dtype=dtype), field((12,), 2, 1, dtype=dtype)
    u, info = prdp.linear_solve(a, b, method(4), x0=x0)
    for of_b, of_x0 in ((60, 60), (-60, -60), (0, 90), (0, -90), (-100, 20)):
        v, again = prdp.linear_solve(a, 2.0**of_b * b, method(4), x0=2.0**of_x0 * x0)
        assert torch.equal(v, 2.0**of_b * u)
        assert torch.equal(info.residual, again.residual) and torch.equal(info.iterations, again.iterations)


@pytest.mark.parametrize(
    "name, method", [case for case in CASES if case[0] in ("poisson", "heat_2d", "stencil", "csr")]
)
def test_samples_do_not_influence_each_other(name, method):
    a, _, b, exact = problem(name)
    x0 = exact + 0.1 * random(*b.shape, seed=5)
    x0[2].view(-1)[1] = float("nan")
    together, info = prdp.linear_solve(a, b, method(3), x0=x0, on_failure="return")
    assert statuses(info)[2] == "NONFINITE_INPUT" and not together[2].any() and together.isfinite().all()
    for i in (0, 1):
        alone, report = prdp.linear_solve(a, b[i : i + 1], method(3), x0=x0[i : i + 1], on_failure="return")
        assert torch.equal(alone[0], together[i])
        assert all(torch.equal(t[0], s[i]) for t, s in zip(report[:4], info[:4], strict=True))
    order = torch.tensor([1, 2, 0])
    permuted = prdp.linear_solve(a, b[order], method(3), x0=x0[order], on_failure="return")[0]
    assert torch.equal(permuted, together[order])


def test_a_start_that_is_not_finite_is_named():
    a, b, x0 = operators.Heat((5,), 1e-3, 1.0), field((5,), 2), field((5,), 2)
    x0[1, 0, 3] = float("inf")
    with pytest.raises(torch.linalg.LinAlgError, match=r"sample 1 NONFINITE_INPUT in x0 at index .0, 3."):
        prdp.linear_solve(a, b, prdp.Jacobi(3), x0=x0)


@pytest.mark.parametrize("method", GENERAL)
def test_an_iteration_that_runs_away_hands_out_no_less_than_the_start(method):
    """0.1 I + 0.9 ones(3) is definite, but Jacobi's iteration grows by 1.8."""
    a = 0.1 * torch.eye(3, dtype=torch.float64) + 0.9
    b, x0 = random(2, 3), random(2, 3, seed=1)
    u, info = prdp.linear_solve(a, b, method(5000), x0=x0, on_failure="return")
    begun = prdp.linear_solve(a, b, method(0), x0=x0)[1]
    if method is prdp.Jacobi:
        assert statuses(info) == ["DIVERGED"] * 2
    assert (info.residual <= begun.residual).all()
    np.testing.assert_allclose((b - u @ a).norm(dim=1) / b.norm(dim=1), info.residual, rtol=1e-6, atol=1e-14)


@pytest.mark.parametrize(
    "x0, message",
    [
        (torch.zeros(2, 1, 6, dtype=torch.float64), r"x0 must have the shape, dtype and device of b, \[2, 1, 5\]"),
        (torch.zeros(2, 1, 5), "got .* in Float"),
    ],
)
def test_a_start_that_does_not_fit_is_refused(x0, message):
    with pytest.raises(ValueError, match=message):
        prdp.linear_solve(operators.Heat((5,), 1e-3, 1.0), field((5,)), prdp.Jacobi(2), x0=x0)


def test_unknown_starts_are_refused(tmp_path):
    with pytest.raises(ValueError, match="start: unknown name 'last'; allowed: zero, state"):
        prdp.Heat((5,), 1e-3, 1.0, prdp.Jacobi(2), start="last")
    with pytest.raises(TypeError, match="x0"):
        prdp.linear_solve(operators.Heat((5,), 1e-3, 1.0), field((5,)), prdp.Jacobi(2), x0=1.0)
    path = written(tmp_path, ('backward = "implicit"', 'backward = "implicit"\nstart = "state"'))
    assert scenes.make_stepper(scenes.load(path)).start == "state"
    assert scenes.make_stepper(scenes.load("heat_1d")).start == "zero"
    with pytest.raises(ValueError, match="start"):
        scenes.load(written(tmp_path, ("rtol = 1e-5", 'rtol = 1e-5\nstart = "last"'), name="other"))


# ---- derivatives

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


@pytest.mark.parametrize("method", [prdp.SteepestDescent, prdp.CG, prdp.CG])
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


# ---- steppers and rollouts


def steppers(backward, **options):
    """name: (stepper from its viscosity, state)."""
    solve = {"backward": backward, "start": "state", "on_failure": "return", **options}
    return {
        "poisson": (lambda nu: prdp.Poisson((9,), prdp.CG(3), **solve), field((9,))),
        "heat": (lambda nu: prdp.Heat((9,), nu, 1.0, prdp.CG(3), **solve), field((9,))),
        "burgers_2d": (lambda nu: prdp.Burgers((4, 5), nu, 0.1, prdp.Jacobi(3), **solve), field((4, 5), channels=2)),
        "picard": (
            lambda nu: prdp.Burgers((9,), nu, 0.1, prdp.GMRES(1, restart=2), picard_steps=2, **solve), field((9,))
        ),
        "navier_stokes": (
            lambda nu: prdp.NavierStokes((4, 5), nu, 0.1, prdp.GMRES(2, restart=3), **solve),
            field((4, 5), channels=3),
        ),
        "own": (
            lambda nu: prdp.ImplicitStep(
                lambda u: operators.Burgers(u, nu, 0.1), lambda u: u - 0.1 * u**3, prdp.Jacobi(3), **solve
            ),
            field((9,)),
        ),
    }  # fmt: skip


def by_hand(stepper, u):
    """One step out of solves that are given their start."""
    b, last = stepper.rhs(u), u
    for _ in range(stepper.equation.picard_steps if isinstance(stepper, prdp.steppers.EquationStepper) else 1):
        solver = {"cg": prdp.CG, "jacobi": prdp.Jacobi, "gmres": prdp.GMRES}[stepper.method](stepper.max_iter)
        solver.restart = stepper.restart
        options = {"backward": stepper.backward, "on_failure": "return"}
        last, _ = prdp.linear_solve(stepper.operator(last), b, solver, x0=last, **options)
    return last


@modes
@pytest.mark.parametrize("name", steppers("none"))
def test_steps_and_rollouts_start_from_the_state(name, backward):
    make, state = steppers(backward)[name]
    bars = random(len(state), 4, *state.shape[1:], seed=3)
    results = []
    for way in ("by hand", "steps", "rollout"):
        nu = torch.tensor(1e-2, dtype=torch.float64, requires_grad=True)
        stepper, u = make(nu), state.clone().requires_grad_()
        if way == "rollout":
            states = stepper.rollout(u, 3)
        else:
            each = [u]
            for _ in range(3):
                each.append(by_hand(stepper, each[-1]) if way == "by hand" else stepper(each[-1]))
            states = torch.stack(each, 1)
        inputs = (u,) if name == "poisson" else (u, nu)
        results.append((states.detach(), *torch.autograd.grad(states, inputs, bars)))
    for other in results[1:]:
        for found, expected in zip(other, results[0], strict=True):
            assert torch.equal(found, expected)
    stepper.start = "zero"
    assert not torch.equal(stepper.rollout(state, 3), results[0][0])


@pytest.mark.parametrize("name, solver", [("heat", prdp.Jacobi), ("heat", prdp.Chebyshev), ("burgers", prdp.Jacobi)])
def test_starting_from_the_state_saves_products_on_trajectories(name, solver):
    x = torch.linspace(0, 1, 65)[:-1]
    u = torch.sin(2 * torch.pi * x)[None, None] + 0.3 * torch.cos(4 * torch.pi * x)
    products = {}
    for start in ("zero", "state"):
        if name == "heat":
            stepper = prdp.Heat((64,), 1e-3, 0.5, solver(500), start=start)
        else:
            stepper = prdp.Burgers((64,), 1e-2, 0.02, solver(500), start=start)
        stepper.rollout(u, 20)
        assert stepper.converged
        products[start] = int(stepper.info.operator_applications.sum())
    assert products["state"] < 0.85 * products["zero"], products


# ---- torch


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@modes
def test_the_ops_pass_opcheck(backward):
    b, x0 = field((5,)).requires_grad_(), field((5,), seed=1)
    nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    options = ("cg", 3, 1e-5, 3, backward, None, None, "raise", 0, 0)
    equation = ([nu], "heat", [5], [0.1], 2)
    for op, arguments in (
        (torch.ops.prdp.linear_solve, (b, [nu], "heat", [5], [1.0], False, *options, x0)),
        (torch.ops.prdp.step, (b, *equation, *options, True)),
        (torch.ops.prdp.rollout_solves, (b, *equation, 4, *options, True)),
        (torch.ops.prdp.rollout, (b, *equation, 2, *options, True)),
    ):
        assert set(opcheck(op.default, arguments).values()) == {"SUCCESS"}


@modes
def test_compiled_and_checkpointed_steps_start_from_the_state(backward):
    torch._dynamo.reset()
    for name in ("heat", "own"):
        make, state = steppers(backward)[name]
        eager = make(1e-2)
        compiled = torch.compile(eager, fullgraph=True, backend="aot_eager")
        gradients = []
        for step in (eager, compiled, lambda u: torch.utils.checkpoint.checkpoint(eager, u, use_reentrant=False)):  # noqa: B023
            u = state.clone().requires_grad_()
            (step(u) ** 2).sum().backward()
            gradients.append(u.grad)
        assert torch.equal(gradients[0], gradients[1]) and torch.equal(gradients[0], gradients[2])


@modes
def test_vmap_maps_a_start(backward):
    a, b, x0 = operators.Heat((6,), 1e-3, 1.0), random(4, 2, 1, 6), random(2, 1, 6, seed=1)

    def solve(b, x0):
        return prdp.linear_solve(a, b, prdp.CG(2), backward=backward, x0=x0)[0]

    several = random(4, 2, 1, 6, seed=2)
    for dims, starts in (((0, None), [x0] * 4), ((0, 0), several), ((0, 1), several)):
        given = x0 if dims[1] is None else several.movedim(0, dims[1])
        expected = torch.stack([solve(*pair) for pair in zip(b, starts, strict=True)])
        assert torch.equal(torch.vmap(solve, dims)(b, given), expected)
    of_start = torch.vmap(solve, (None, 0))(b[0], several)
    assert torch.equal(of_start, torch.stack([solve(b[0], x) for x in several]))

    def loss(b):
        return solve(b, x0).square().sum()

    mapped = torch.vmap(torch.func.grad(loss))(b)
    torch.testing.assert_close(mapped, torch.stack([torch.func.grad(loss)(one) for one in b]))


def test_autocast_takes_low_precision_for_a_start():
    step = prdp.ImplicitStep(operators.Heat((9,), 1e-3, 1.0), None, prdp.CG(3), start="state")
    u = field((9,), dtype=torch.bfloat16)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = step(u)
    assert torch.equal(found, step(u.float()))
