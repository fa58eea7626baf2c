"""Where methods fail: the cases of docs/stability.md with their true outcomes."""

import numpy as np
import pytest
import torch
from helpers import ITERATIVE, SOLVERS, field, golden, spd_matrices, statuses

import prdp_torch as prdp
from prdp_torch import operators

F = golden("failures")


def array(name):
    return torch.tensor(F[name])


def solve(case, solver, **options):
    options.setdefault("on_failure", "return")
    return prdp.linear_solve(array(f"{case}__A"), array(f"{case}__b"), solver, **options)


def test_a01_zero_right_hand_side_is_solved_in_no_iterations_and_has_a_derivative():
    for backward in ("implicit", "unrolled"):
        a, b = array("A01__A").requires_grad_(), array("A01__b").requires_grad_()
        u, info = prdp.linear_solve(a, b, prdp.Jacobi(400, rtol=1e-14), backward=backward)
        u.backward(array("A01__g"))
        assert torch.equal(u, torch.zeros_like(u))
        assert info.iterations.tolist() == [0] and statuses(info) == ["CONVERGED"]
        np.testing.assert_allclose(b.grad, F["A01__lam"], rtol=1e-10, atol=1e-12)
        assert torch.equal(a.grad, torch.zeros_like(a))


def test_a02_zero_diagonal_and_breakdown():
    u, info = solve("A02", prdp.Jacobi(10))
    assert statuses(info) == ["ZERO_DIAGONAL"] and torch.equal(u, torch.zeros_like(u))
    assert info.operator_applications.tolist() == [0]
    for solver in (prdp.SteepestDescent(10), prdp.CG(10), prdp.SteepestDescent(10, rtol=0.0)):
        u, info = solve("A02", solver)
        assert statuses(info) == ["BREAKDOWN"] and torch.equal(u, torch.zeros_like(u))
        assert info.iterations.tolist() == [0]
    u, info = solve("A02", prdp.Direct())
    np.testing.assert_allclose(u, F["A02__u"])


def test_a03_a_cyclic_shift_breaks_steepest_descent_down():
    _, info = solve("A03", prdp.SteepestDescent(50))
    assert statuses(info) == ["BREAKDOWN"] and info.residual.tolist() == [1.0]
    np.testing.assert_allclose(solve("A03", prdp.Direct())[0], F["A03__u"], atol=1e-14)


@pytest.mark.parametrize("rtol", [1e-5, 0.0])
def test_a07_jacobi_diverges_where_steepest_descent_converges(rtol):
    u, info = solve("A07", prdp.Jacobi(500, rtol=rtol))
    assert statuses(info) == ["DIVERGED"]
    assert torch.isfinite(u).all() and info.residual.item() <= 1.0
    u, info = solve("A07", prdp.SteepestDescent(500))
    assert statuses(info) == ["CONVERGED"] and info.iterations.tolist() == [79]
    np.testing.assert_allclose(u, F["A07__u"], rtol=1e-3)


def test_a07_is_no_divergence_while_the_residual_merely_grows():
    """But none of its iterates is better than zero, which is handed out."""
    u, info = solve("A07", prdp.Jacobi(10, rtol=0.0))
    assert statuses(info) == ["MAX_ITER"] and info.residual.item() == 1.0 and not u.any()


def test_a09_jacobi_never_converges_on_the_periodic_laplacian():
    _, info = solve("A09_16", prdp.Jacobi(2000))
    assert statuses(info) == ["MAX_ITER"]


@pytest.mark.parametrize("solver", SOLVERS)
def test_a14_nonfinite_data_is_found_before_iterating(solver):
    a, b = array("A14__A"), array("A14__b")
    bad_b, bad_a = array("A14__b_nan"), array("A14__A_inf")
    where = int(torch.isnan(bad_b).nonzero()[0])
    row, column = torch.isinf(bad_a).nonzero()[0].tolist()
    with pytest.raises(torch.linalg.LinAlgError, match=rf"sample 0 NONFINITE_INPUT at index \({where},\)"):
        prdp.linear_solve(a, bad_b, solver(5))
    with pytest.raises(torch.linalg.LinAlgError, match=rf"sample 0 NONFINITE_OPERATOR at index \({row}, {column}\)"):
        prdp.linear_solve(bad_a, b, solver(5))
    with pytest.raises(torch.linalg.LinAlgError, match=rf"NONFINITE_OPERATOR at index \({row}, {column}\)"):
        prdp.linear_solve(bad_a.to_sparse_csr(), b, solver(5))
    for matrix, rhs in ((a, bad_b), (bad_a, b)):
        u, info = prdp.linear_solve(matrix, rhs, solver(5), on_failure="return")
        assert torch.equal(u, torch.zeros_like(u)) and info.iterations.tolist() == [0]


def test_b02_steepest_descent_grows_and_then_converges():
    u, info = solve("B02_0", prdp.SteepestDescent(1000, rtol=1e-10))
    assert statuses(info) == ["CONVERGED"]
    np.testing.assert_allclose(u, F["B02_0__u"], rtol=0, atol=1e-8)


def test_b02_in_float32_what_is_said_of_the_residual_is_true():
    a, b = array("B02_0__A"), array("B02_0__b")
    for k in (20, 60, 100, 300):
        u, info = prdp.linear_solve(a.float(), b.float(), prdp.SteepestDescent(k), on_failure="return")
        residual = float((b.float().double() - a.float().double() @ u.double()).norm() / b.norm())
        assert info.residual.item() == pytest.approx(residual, rel=0.05)
        assert (residual <= 1.05e-5) == (statuses(info) == ["CONVERGED"])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_c01_finite_rows_equal_their_solo_runs(dtype):
    a, rows = array("C01__A").to(dtype), array("C01__B").to(dtype)
    for solver in SOLVERS:
        u, info = prdp.linear_solve(a, rows, solver(200), on_failure="return")
        assert [s == "NONFINITE_INPUT" for s in statuses(info)] == (~rows.isfinite().all(1)).tolist()
        for i in rows.isfinite().all(1).nonzero().flatten().tolist():
            alone, report = prdp.linear_solve(a, rows[i], solver(200))
            assert torch.equal(alone, u[i]) and report.iterations.item() == info.iterations[i].item()
        finite = rows.isfinite().all(1)
        if dtype == torch.float64:
            expected = F["C01__U"][finite.numpy()]
            scale = np.abs(expected).max(1, keepdims=True) + 1e-300
            np.testing.assert_allclose(u[finite].numpy() / scale, expected / scale, rtol=0, atol=1e-4)


def test_d05_jacobi_may_grow_eight_hundredfold_and_be_exact_at_the_eighth_sweep():
    _, after_one = solve("D05", prdp.Jacobi(1, rtol=0.0))
    assert after_one.residual.item() == 1.0 and after_one.iterations.item() == 0  # zero is better
    u, info = solve("D05", prdp.Jacobi(50))
    assert info.iterations.tolist() == [8] and statuses(info) == ["CONVERGED"]
    np.testing.assert_allclose(u, F["D05__u"], rtol=1e-12)


@pytest.mark.parametrize("method, name", [(prdp.Jacobi, "jacobi"), (prdp.SteepestDescent, "sd")])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_e01_both_modes_at_two_iterations(method, name, backward):
    a, b = array("E01__A").requires_grad_(), array("E01__b").requires_grad_()
    u, _ = prdp.linear_solve(a, b, method(2, rtol=0.0), backward=backward)
    u.backward(array("E01__g"))
    np.testing.assert_allclose(u.detach(), F[f"E01__{name}_K2_u"], rtol=0, atol=1e-13)
    np.testing.assert_allclose(b.grad, F[f"E01__{name}_K2_gb_{backward}"], rtol=0, atol=1e-13)
    np.testing.assert_allclose(a.grad, F[f"E01__{name}_K2_gA_{backward}"], rtol=0, atol=1e-13)


@pytest.mark.parametrize("solver", ITERATIVE)
def test_a_tolerance_below_the_dtype_is_called_stagnation(solver):
    b = field((128,), batch=2, dtype=torch.float32)
    budget = 60000 if solver is not prdp.CG else 2000
    u, info = prdp.linear_solve(operators.Poisson((128,)), b, solver(budget, rtol=1e-6))
    assert statuses(info) == ["STAGNATED"] * 2
    # Rounding over 30,000 iterations takes steepest descent to 3e-3 on some right-hand sides, Jacobi to 2e-5.
    assert torch.isfinite(u).all() and (info.residual < 5e-3).all() and (info.residual > 1e-6).all()


@pytest.mark.parametrize("solver", ITERATIVE)
def test_overflow_is_said_and_a_finite_iterate_handed_out(solver):
    a = torch.tensor([[1e30, 1e30], [1e30, 2e30]], dtype=torch.float32)
    u, info = prdp.linear_solve(torch.stack([a, torch.eye(2)]), torch.ones(2, 2), solver(20), on_failure="return")
    assert torch.isfinite(u).all()
    assert info.status[1] > 0
    np.testing.assert_allclose(u[1], torch.ones(2), rtol=1e-6)
    assert statuses(info)[0] in ("OVERFLOW", "CONVERGED", "CONVERGED_BREAKDOWN", "MAX_ITER")
    residual = (1.0 - (a.double() @ u[0].double())).norm() / 2**0.5
    assert info.residual[0].item() == pytest.approx(float(residual), rel=1e-3, abs=1e-6)


def test_a_solution_beyond_the_dtype_overflows():
    b = torch.full((1, 3), 3e38)
    u, info = prdp.linear_solve(torch.eye(3) * 0.1, b, prdp.Jacobi(5), on_failure="return")
    assert statuses(info) == ["OVERFLOW"] and torch.isfinite(u).all()


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("solver", SOLVERS)
def test_no_nan_without_a_negative_status_in_either_mode(backward, solver):
    generator = torch.Generator().manual_seed(0)
    m = torch.randn(40, 4, 4, generator=generator, dtype=torch.float64)
    m[0] = 0.0  # singular
    m[1, :, 0] = 0.0
    m[2].diagonal().zero_()
    m = m.requires_grad_()
    b = torch.randn(40, 4, generator=generator, dtype=torch.float64)
    b[3] = 0.0
    b = b.requires_grad_()
    u, info = prdp.linear_solve(m, b, solver(300), backward=backward, on_failure="return")
    u.sum().backward()
    assert torch.isfinite(u).all()
    assert torch.isfinite(b.grad).all() and torch.isfinite(m.grad).all()
    assert (info.status < -2).any()
    assert (info.residual[info.status > 0] <= 1e-5).all()


def test_direct_on_a_singular_matrix_breaks_down():
    _, info = prdp.linear_solve(torch.zeros(3, 3), torch.ones(3), prdp.Direct(), on_failure="return")
    assert statuses(info) == ["BREAKDOWN"]
    sparse = torch.tensor([[1.0, 1.0], [1.0, 1.0]]).to_sparse_csr()
    _, info = prdp.linear_solve(sparse, torch.tensor([1.0, 2.0]), prdp.Direct(), on_failure="return")
    assert statuses(info) == ["BREAKDOWN"]


def test_failures_raise_warn_or_return():
    a, b = array("A07__A"), array("A07__b")
    message = r"linear_solve: 1 of 1 samples failed: sample 0 DIVERGED .*the residual grew beyond 1e13"
    with pytest.raises(torch.linalg.LinAlgError, match=message):
        prdp.linear_solve(a, b, prdp.Jacobi(500))
    with pytest.warns(UserWarning, match=message):
        u, info = prdp.linear_solve(a, b, prdp.Jacobi(500), on_failure="warn")
    again, report = prdp.linear_solve(a, b, prdp.Jacobi(500), on_failure="return")
    assert torch.equal(u, again) and statuses(info) == statuses(report) == ["DIVERGED"]


def test_reaching_max_iter_is_normal_life():
    prdp.Heat((30,), 1e-3, 1.0, solver=prdp.Jacobi(1))(field((30,)))


def test_adjoint_failures_are_reported_on_their_own():
    heat = prdp.Heat((9,), 1e-3, 1.0, solver=prdp.Jacobi(20), on_failure="raise")
    u = heat(field((9,)).requires_grad_())
    cotangent = field((9,), seed=1)
    cotangent[1, 0, 4] = float("inf")
    with pytest.raises(
        torch.linalg.LinAlgError, match=r"adjoint solve: 1 of 2 .*sample 1 NONFINITE_INPUT at index \(0, 4\)"
    ):
        u.backward(cotangent)
    assert statuses(heat.info) == ["CONVERGED"] * 2
    assert statuses(heat.adjoint_info)[1] == "NONFINITE_INPUT"
    heat.on_failure = "warn"
    b = field((9,)).requires_grad_()
    with pytest.warns(UserWarning, match="adjoint solve: 1 of 2 samples failed"):
        heat(b).backward(cotangent)
    assert torch.isfinite(b.grad).all() and torch.equal(b.grad[1], torch.zeros_like(b.grad[1]))


def test_many_failures_are_named_shortly():
    b = torch.full((20, 1, 5), float("nan"))
    with pytest.raises(torch.linalg.LinAlgError, match=r"20 of 20 samples failed: sample 0 .*and 16 more") as error:
        prdp.Heat((5,), 1e-3, 1.0, solver=prdp.Jacobi(2))(b)
    assert len(str(error.value)) < 800


def test_the_adjoint_of_the_one_mode_problem_needs_its_own_status():
    """Steepest descent solves an eigenvector in one iteration; its adjoint has another right-hand side."""
    x = torch.arange(1, 31, dtype=torch.float64) / 31
    b = torch.sin(2 * torch.pi * x)[None, None].requires_grad_()
    poisson = prdp.Poisson((30,), solver=prdp.SteepestDescent(300))
    poisson(b).backward(field((30,), batch=1))
    assert statuses(poisson.info) == ["CONVERGED"] and poisson.info.iterations.tolist() == [1]
    assert statuses(poisson.adjoint_info) == ["MAX_ITER"]
    assert poisson.adjoint_info.residual.item() > 1e-2 and not poisson.converged


def test_statuses_are_the_same_set_in_both_directions():
    assert {s.name: s.value for s in prdp.SolveStatus} == {
        "CONVERGED_BREAKDOWN": 2, "CONVERGED": 1, "MAX_ITER": -1, "STAGNATED": -2, "DIVERGED": -3,
        "OVERFLOW": -4, "BREAKDOWN": -5, "ZERO_DIAGONAL": -6, "INCONSISTENT": -7, "NONFINITE_INPUT": -8,
        "NONFINITE_OPERATOR": -9,
    }  # fmt: skip


def test_spd_systems_never_fail():
    m = spd_matrices(50, 8, seed=5)
    b = torch.randn(50, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    for solver in SOLVERS:
        _, info = prdp.linear_solve(m, b, solver(500))
        assert (info.status > 0).all()


@pytest.mark.parametrize("method", [prdp.Jacobi, prdp.Chebyshev])
@pytest.mark.parametrize("backward", ["implicit", "none"])
def test_sweeps_notice_that_they_are_at_their_rounding(method, backward):
    """Jacobi reaches 6e-6 of Poisson's load in float32, and then nothing less however long it goes on.

    Sweeps stop within eight times ε ‖A‖ ‖u‖, where ‖A‖ = 4/dx² and ‖u‖ = ‖b‖/(2πk)²."""
    x = torch.linspace(0, 1, 32)[1:-1]
    loads = torch.stack([torch.sin(2 * torch.pi * k * x) for k in (1, 2, 3)])[:, None].requires_grad_()
    poisson = prdp.Poisson((30,), method(100_000, rtol=1e-7), backward=backward)
    u = poisson(loads)
    assert statuses(poisson.info) == ["STAGNATED"] * 3
    floor = torch.finfo(torch.float32).eps * 4 * 31**2 / (2 * torch.pi * torch.tensor([1, 2, 3])) ** 2
    assert (poisson.info.iterations < 1500).all() and (poisson.info.residual < 8 * floor).all()
    if backward == "implicit":
        u.backward(loads.detach())
        assert statuses(poisson.adjoint_info) == ["STAGNATED"] * 3 and (poisson.adjoint_info.iterations < 1500).all()
    exact = prdp.Poisson((30,), prdp.Direct())(loads.detach().double())
    torch.testing.assert_close(u.double(), exact, rtol=0, atol=1e-4 * float(exact.abs().max()))
