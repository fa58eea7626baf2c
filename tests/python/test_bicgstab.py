"""BiCGStab, against the textbook and dense LAPACK."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import dense_burgers, dense_heat, field, spd_matrices, statuses, written
from test_other_devices import OFFSETS, SHAPE, five_points, noise
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp
from prdp_torch import _C, operators
from prdp_torch.experiments import scenes
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train

TRAINER = Path(__file__).parents[2] / "build" / "prdp_train"

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script")
CSR_WARNS = pytest.mark.filterwarnings("ignore:linear_solve. the gradient of a sparse CSR tensor")
TILT = 1 + 0.3 * torch.randn(3, 6, 6, generator=torch.Generator().manual_seed(5)).double().tril(-1)
MATRICES = spd_matrices(3, 6) * TILT
SHIFTS = torch.logspace(0, 1, 6, dtype=torch.float64)
WINDS = field((6,), 3, seed=1)
WINDS_2D = field((4, 3), 3, seed=2, channels=2)
COEFFICIENTS = torch.stack([4 + field((6,), 3, 6)[:, 0].abs(), -field((6,), 3, 7)[:, 0].abs(),
                            -0.5 * field((6,), 3, 8)[:, 0].abs()], 1)  # fmt: skip


def bicgstab(max_iter, rtol=0.0):
    return prdp.BiCGStab(max_iter, rtol=rtol)


def function(shift):
    return operators.Function(
        lambda v, k: (1 + k) * v - 0.3 * v.roll(1, -1), tensors=(shift,), diagonal=lambda k: 1 + k
    )


def stencil(c):
    return operators.Stencil(c, ((0,), (-1,), (1,)), boundary="periodic")


def dense_stencil(c):
    eye = np.eye(c.shape[1])
    return np.diag(c[0]) + c[1][:, None] * np.roll(eye, -1, 1) + c[2][:, None] * np.roll(eye, 1, 1)


# name: (operator out of its tensors, the tensors, shape of a right-hand side, dense matrices of the samples)
CASES = {
    "heat": (lambda nu: operators.Heat((2, 3), nu, 1.0), (torch.tensor(2e-3, dtype=torch.float64),), (1, 2, 3),
             [dense_heat((2, 3), 2e-3)] * 3),
    "burgers": (lambda w: operators.Burgers(w, 2e-2, 0.2), (WINDS,), (1, 6),
                [dense_burgers(w.numpy(), 2e-2, 0.2) for w in WINDS]),
    "burgers_2d": (lambda w: operators.Burgers(w, 2e-2, 0.2), (WINDS_2D,), (2, 4, 3),
                   [dense_burgers(w.numpy(), 2e-2, 0.2) for w in WINDS_2D]),
    "stencil": (stencil, (COEFFICIENTS,), (1, 6), [dense_stencil(c.numpy()) for c in COEFFICIENTS]),
    "dense": (operators.Matrix, (MATRICES,), (6,), list(MATRICES.numpy())),
    "negative": (operators.Matrix, (-MATRICES[0],), (6,), [-MATRICES[0].numpy()] * 3),
    "csr": (lambda m: operators.Matrix(m.to_sparse_csr()), (MATRICES,), (6,), list(MATRICES.numpy())),
    "function": (function, (SHIFTS,), (6,),
                 [np.diag(1 + SHIFTS.numpy()) - 0.3 * np.roll(np.eye(6), 1, 0)] * 3),
}  # fmt: skip


def rhs(shape, dtype=torch.float64, batch=3):
    generator = torch.Generator().manual_seed(4)
    return torch.randn(batch, *shape, dtype=torch.float64, generator=generator).to(dtype)


def textbook(a, b, iterations):
    """Van der Vorst 1992, as Saad has it: algorithm 7.7."""
    x, r, p, first = np.zeros_like(b), b, b, b
    for _ in range(iterations):
        alpha = (r @ first) / (a @ p @ first)
        s = r - alpha * (a @ p)
        omega = (a @ s @ s) / (a @ s @ (a @ s))
        x = x + alpha * p + omega * s
        after = s - omega * (a @ s)
        beta = (after @ first) / (r @ first) * alpha / omega
        p, r = after + beta * (p - omega * (a @ p)), after
    return x


@pytest.mark.parametrize("name", CASES)
def test_iterates_are_those_of_the_textbook_at_two_products_each(name):
    make, tensors, shape, matrices = CASES[name]
    b, a = rhs(shape), make(*tensors)
    for k in (0, 1, 2, 3):
        u, info = prdp.linear_solve(a, b, bicgstab(k))
        v, report = _C.solve_with_tensors(b, a.tensors, a.kind, a.shape, a.parameters, False, "bicgstab", k, 0.0)
        assert info.operator_applications.tolist() == report[3].tolist() == [2 * k + 1] * 3
        for i, matrix in enumerate(matrices):
            flat = b[i].flatten().numpy()
            expected = textbook(matrix, flat, k)
            for found in (u, v):
                np.testing.assert_allclose(found[i].flatten(), expected, rtol=1e-8, atol=1e-11)
            true = np.linalg.norm(flat - matrix @ u[i].flatten().numpy()) / np.linalg.norm(flat)
            assert float(info.residual[i]) == pytest.approx(true, rel=1e-6, abs=1e-14)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype, rtol", [(torch.float32, 1e-5), (torch.float64, 1e-11)])
def test_it_solves_in_the_loops_and_in_plain_tensors(name, dtype, rtol):
    make, tensors, shape, matrices = CASES[name]
    b, a = rhs(shape, dtype), make(*(t.to(dtype if t.dim() else torch.float64) for t in tensors))
    u, info = prdp.linear_solve(a, b, bicgstab(60, rtol))
    v, report = _C.solve_with_tensors(b, a.tensors, a.kind, a.shape, a.parameters, False, "bicgstab", 60, rtol)
    assert statuses(info) == ["CONVERGED"] * 3 and bool((info.residual <= rtol).all())
    assert bool((report[2] == 1).all()) and bool(((report[0] - info.iterations).abs() <= 1).all())
    for found in (u, v):
        for i, matrix in enumerate(matrices):
            exact = np.linalg.solve(matrix, b[i].flatten().double().numpy())
            error = np.linalg.norm(found[i].flatten().double().numpy() - exact)
            assert error <= 4 * rtol * np.linalg.cond(matrix) * np.linalg.norm(exact)


@pytest.mark.parametrize("n", [2, 7, 16, 33, 100])
@pytest.mark.parametrize("dtype, rtol", [(torch.float32, 2e-5), (torch.float64, 1e-10)])
def test_burgers_of_all_sizes_at_large_time_steps(n, dtype, rtol):
    """At a CFL number of 10 and 100 ρ runs out of digits in float32; it starts anew and converges all the same."""
    winds = field((n,), 4, n, dtype)
    for cfl in (1, 10, 100):
        a = operators.Burgers(winds, 1e-3, cfl / n)
        u, info = prdp.linear_solve(a, winds, bicgstab(4000, rtol), on_failure="return")
        assert statuses(info) == ["CONVERGED"] * 4, (cfl, info)
        for i in range(4):
            matrix, b = dense_burgers(winds[i].double().numpy(), 1e-3, cfl / n), winds[i, 0].double().numpy()
            assert np.linalg.norm(b - matrix @ u[i, 0].double().numpy()) <= 1.5 * rtol * np.linalg.norm(b)


def solve_of(a, b, k=50, rtol=1e-10, **options):
    a, b = torch.tensor(a, dtype=torch.float64), torch.tensor(b, dtype=torch.float64)
    return prdp.linear_solve(a, b, bicgstab(k, rtol), on_failure="return", **options)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", [operators.Matrix, lambda a: operators.Function(lambda v: (v[:, None] * a).sum(-1))])
def test_it_starts_anew_where_a_direction_is_orthogonal_to_the_first_residual(kind, dtype):
    """r̂·A p is zero in the second iteration, by hand in fractions. A neighbour is solved as it is alone."""
    a = torch.tensor([[3.0, -1, 0, -2], [2, 4, -2, 0], [0, -1, 2, -2], [2, -1, 0, 3]], dtype=dtype)
    b = torch.tensor([[0.0, 0, 2, 2], [1, 2, 3, 5]], dtype=dtype)
    u, info = prdp.linear_solve(kind(a), b, bicgstab(20, 1e-6))
    assert (info.status > 0).all() and info.iterations[0] <= 8
    torch.testing.assert_close(u, torch.linalg.solve(a, b.mT).mT, rtol=1e-4, atol=1e-5)
    alone, _ = prdp.linear_solve(kind(a), b[1:], bicgstab(20, 1e-6))
    torch.testing.assert_close(u[1:], alone, rtol=0, atol=0)


@pytest.mark.parametrize("rtol", [0.0, 1e-10])
def test_breakdowns_are_said_and_keep_the_last_iterate(rtol):
    # r̂·Ar = 0 at once
    for a in ([[0.0, 1.0], [-1.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]):
        u, info = solve_of(a, [1.0, 0.0], rtol=rtol)
        assert statuses(info) == ["BREAKDOWN"] and info.iterations.tolist() == [0]
        assert u.tolist() == [0.0, 0.0] and info.residual.tolist() == [1.0]
    # s = (0, 1) and s·As = 0: ω is zero, and the first iteration is half a one
    u, info = solve_of([[1.0, 1.0], [-1.0, 0.0]], [1.0, 0.0], rtol=rtol)
    assert statuses(info) == ["BREAKDOWN"] and info.iterations.tolist() == [1]
    assert u.tolist() == [1.0, 0.0] and info.residual.tolist() == [1.0]
    with pytest.raises(
        torch.linalg.LinAlgError,
        match=r"BiCGStab on Matrix: r·A r is zero for a residual r, or u grew without end; take GMRES",
    ):
        prdp.linear_solve(torch.tensor([[0.0, 1.0], [-1.0, 0.0]]), torch.ones(2), bicgstab(4))


def test_a_residual_orthogonal_to_the_first_one_starts_it_anew():
    """ρ is exactly zero after the first iteration, where the textbook divides by it."""
    a, b = [[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 1.0, 1.0]], [1.0, 0.0, 0.0]
    one, info = solve_of(a, b, 1, 0.0)
    assert one.tolist() == [1.0, 0.5, 0.0]
    with np.errstate(divide="ignore", invalid="ignore"):
        assert np.isnan(textbook(np.array(a), np.array(b), 3)).any()
    u, info = solve_of(a, b)
    assert statuses(info) == ["CONVERGED"]
    np.testing.assert_allclose(u, np.linalg.solve(a, b), atol=1e-9)


def test_no_iteration_past_the_solution_makes_a_nan():
    for a in (torch.eye(5, dtype=torch.float64), MATRICES[0, :5, :5]):
        for dtype in (torch.float32, torch.float64):
            b = rhs((5,), dtype)
            u, info = prdp.linear_solve(a.to(dtype), b, bicgstab(300), on_failure="return")
            exact = torch.linalg.solve(a, b.double().mT).mT
            torch.testing.assert_close(u.double(), exact, rtol=0, atol=100 * torch.finfo(dtype).eps)
            assert bool(info.residual.isfinite().all())


def test_samples_keep_to_themselves_to_the_last_bit():
    w = field((33,), 6, 1)
    b = field((33,), 6, 2)
    b[1], b[2, 0, 3], w[3, 0, 2] = 0.0, float("nan"), float("inf")
    solver = bicgstab(40, 1e-9)
    together, info = prdp.linear_solve(operators.Burgers(w, 1e-3, 0.2), b, solver, on_failure="return")
    assert statuses(info)[:4] == ["CONVERGED", "CONVERGED", "NONFINITE_INPUT", "NONFINITE_OPERATOR"]
    order = torch.tensor([4, 2, 0, 5, 1, 3])
    mixed, _ = prdp.linear_solve(operators.Burgers(w[order], 1e-3, 0.2), b[order], solver, on_failure="return")
    assert torch.equal(mixed, together[order])
    for i in range(6):
        alone, own = prdp.linear_solve(
            operators.Burgers(w[i : i + 1], 1e-3, 0.2), b[i : i + 1], solver, on_failure="return"
        )
        assert torch.equal(alone[0], together[i]) and int(own.iterations) == int(info.iterations[i])
        assert int(own.operator_applications) == int(info.operator_applications[i])


@pytest.mark.parametrize("dtype, power", [(torch.float32, 100), (torch.float64, 900)])
def test_powers_of_two_pass_through_exactly(dtype, power):
    w, b = field((20,), 3, 1, dtype), field((20,), 3, 2, dtype)
    found = []
    for factor in (1.0, 2.0**-power, 2.0**power):
        x = (b * factor).requires_grad_()
        u, info = prdp.linear_solve(operators.Burgers(w, 1e-2, 0.2), x, bicgstab(30))
        (g,) = torch.autograd.grad(u, x, b * factor)
        found.append((u / factor, g / factor, info.iterations))
    for other in found[1:]:
        assert all(torch.equal(one, two) for one, two in zip(found[0], other, strict=True))


@CSR_WARNS
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("backward, k, rtol", [("implicit", 60, 1e-14), ("unrolled", 1, 0.0), ("unrolled", 3, 0.0)])
def test_derivatives(name, backward, k, rtol):
    make, tensors, shape, _ = CASES[name]

    def solve(b, *tensors):
        return prdp.linear_solve(make(*tensors), b, bicgstab(k, rtol), backward=backward, on_failure="return")[0]

    inputs = (rhs(shape).requires_grad_(), *(t.clone().requires_grad_() for t in tensors))
    assert gradcheck(solve, inputs)
    if name in ("burgers", "dense"):
        assert gradgradcheck(solve, inputs, atol=1e-4)


def test_a_truncated_adjoint_is_the_truncated_solve_with_the_transpose():
    a, b, g = MATRICES, rhs((6,)), rhs((6,)).flip(0)
    x = b.clone().requires_grad_()
    u, info = prdp.linear_solve(a, x, bicgstab(60, 1e-12), adjoint_max_iter=2, adjoint_rtol=0.0)
    (found,) = torch.autograd.grad(u, x, g)
    for i in range(3):
        np.testing.assert_allclose(found[i], textbook(a[i].numpy().T, g[i].numpy(), 2), rtol=1e-9)
    assert statuses(info.adjoint) == ["MAX_ITER"] * 3 and info.adjoint.operator_applications.tolist() == [5] * 3


def test_it_starts_where_it_is_told_to():
    a, b = operators.Burgers(field((40,), 3, 1), 1e-3, 0.5), rhs((1, 40))
    exact, _ = prdp.linear_solve(a, b, prdp.Direct())
    u, info = prdp.linear_solve(a, b, bicgstab(30, 1e-8), x0=exact + 1e-3 * b)
    _, from_zero = prdp.linear_solve(a, b, bicgstab(30, 1e-8))
    assert bool((info.iterations < from_zero.iterations).all()) and statuses(info) == ["CONVERGED"] * 3
    torch.testing.assert_close(u, exact, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_transforms_and_compilation(backward):
    torch._dynamo.reset()
    step = prdp.Burgers((6,), 2e-2, 0.2, prdp.BiCGStab(3, rtol=0.0), backward)
    u, v = field((6,), 3, 11), field((6,), 3, 12)
    x = u.clone().requires_grad_()
    eager = step(x)
    (gradient,) = torch.autograd.grad(eager, x, v)
    y = u.clone().requires_grad_()
    compiled = torch.compile(step, fullgraph=True, backend="aot_eager")(y)
    assert torch.equal(compiled, eager)
    torch.testing.assert_close(torch.autograd.grad(compiled, y, v)[0], gradient)
    torch.testing.assert_close(torch.func.vmap(step)(u[:, None])[:, 0], eager.detach())
    value, tangent = torch.func.jvp(step, (u,), (v,))
    torch.testing.assert_close(value, eager.detach())
    if backward == "unrolled":  # else of a truncated solve, as the adjoint is: they meet at convergence
        torch.testing.assert_close((tangent * v).sum(), (gradient * v).sum())
    else:
        exact = prdp.Burgers((6,), 2e-2, 0.2, prdp.BiCGStab(40, rtol=1e-13))
        difference = (exact(u + 1e-6 * v) - exact(u - 1e-6 * v)).detach() / 2e-6
        torch.testing.assert_close(torch.func.jvp(exact, (u,), (v,))[1], difference, rtol=1e-6, atol=1e-8)


def test_both_trainers_take_it(tmp_path):
    path = written(tmp_path, ('method = "jacobi"', 'method = "bicgstab"'))
    command = [TRAINER, path, "--out", tmp_path / "cpp", "--constant", "4", "--intervals", "2"]
    subprocess.run(command, check=True, capture_output=True)
    cpp = json.loads(next((tmp_path / "cpp").glob("*/seed_0.json")).read_text())["curves"]
    scene = scenes.load(path)
    scene.training.intervals = 2
    python = train(scene, Refinement.constant(4))
    np.testing.assert_allclose(cpp["metric"], python["metric"], rtol=1e-4)
    assert cpp["budget"] == python["budget"] and python["metric"][-1] < python["metric"][0]


@pytest.mark.parametrize("k", [12, 20])
def test_unrolled_gradients_of_a_are_those_of_differences_but_near_rounding(k):
    """K = 12 ends before residuals of 1e-6, and at K = 20 the sample is solved to rounding. Between, Ā is rounding."""
    b, c = noise(3, 1, *SHAPE), five_points(4.3)
    direction = noise(*c.shape, seed=5)

    def loss(c, b, k=k):
        a = operators.Stencil(c, OFFSETS, "periodic")
        return prdp.linear_solve(a, b, prdp.BiCGStab(k, 0.0), backward="unrolled")[0].square().sum()

    leaf, h = c.clone().requires_grad_(), 1e-7
    (found,) = torch.autograd.grad(loss(leaf, b), leaf)
    expected = (loss(c + h * direction, b) - loss(c - h * direction, b)) / (2 * h)
    torch.testing.assert_close((found * direction).sum(), expected, rtol=1e-7, atol=0)
    leaf = b.clone().requires_grad_()
    between, end = (torch.autograd.grad(loss(c, leaf, k), leaf)[0] for k in (16, 40))
    torch.testing.assert_close(between, end, rtol=1e-8, atol=1e-8)
