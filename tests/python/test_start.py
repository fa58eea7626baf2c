"""Where solves start: x0 of linear_solve, its scale, what it saves and what it never spoils."""

import numpy as np
import pytest
import torch
from helpers import (
    dense_burgers,
    dense_heat,
    dense_laplacian,
    dense_navier_stokes,
    field,
    random,
    spd_matrices,
    statuses,
    written,
)
from starts import GENERAL, SYMMETRIC

import prdp_torch as prdp
from prdp_torch import _C, operators
from prdp_torch.experiments import scenes


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
        # One cycle of as many vectors as there are unknowns would end at rounding, and might end at exactly zero.
        solver = prdp.GMRES(k, rtol=rtol, restart=2) if method is prdp.GMRES else method(k, rtol=rtol)
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
        (torch.zeros(2, 1, 5), "got .* in float32"),
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
