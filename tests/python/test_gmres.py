"""GMRES: what it does that the other methods do not."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import golden, statuses
from hypothesis import given, settings
from hypothesis import strategies as st

import prdp_torch as prdp
from prdp_torch import _C, operators

F = golden("failures")


def nonsymmetric(batch, n, seed=0, shift=3.0):
    """Well-conditioned matrices with complex eigenvalues."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(batch, n, n, generator=generator, dtype=torch.float64)
    return a + shift * n**0.5 * torch.eye(n, dtype=torch.float64)


def right_hand_sides(batch, n, seed=1):
    return torch.randn(batch, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def solve(case, solver):
    return prdp.linear_solve(torch.tensor(F[f"{case}__A"]), torch.tensor(F[f"{case}__b"]), solver, on_failure="return")


def least_residual(a, b, m):
    """min ‖b - A x‖ over the Krylov space of dimension m, through numpy's SVD."""
    basis = np.stack([np.linalg.matrix_power(a, j) @ b for j in range(m)], 1)
    q, _ = np.linalg.qr(basis)
    return np.linalg.norm(b - a @ q @ np.linalg.lstsq(a @ q, b, rcond=None)[0])


@pytest.mark.parametrize("n", [1, 2, 7, 16, 33])
@pytest.mark.parametrize("m", [1, 3, 8])
def test_a_cycle_takes_the_least_residual_of_its_krylov_space(n, m):
    a, b = nonsymmetric(3, n), right_hand_sides(3, n)
    _, info = prdp.linear_solve(a, b, prdp.GMRES(1, restart=m, rtol=0.0))
    for i in range(3):
        expected = least_residual(a[i].numpy(), b[i].numpy(), min(m, n)) / np.linalg.norm(b[i])
        assert info.residual[i].item() == pytest.approx(expected, rel=1e-8, abs=1e-13)
    assert info.operator_applications.tolist() == [min(m, n) + 1] * 3


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 24), st.integers(1, 9), st.sampled_from([torch.float32, torch.float64]))
def test_the_residual_never_grows(seed, n, m, dtype):
    """On any matrix, also singular and indefinite ones. What no residual sees, a part in the null space of
    a matrix that is singular but for rounding, stays below what rounding leaves of b."""
    generator = torch.Generator().manual_seed(seed)
    rank = int(torch.randint(1, n + 1, (), generator=generator))
    a = torch.randn(n, rank, generator=generator, dtype=dtype) @ torch.randn(rank, n, generator=generator, dtype=dtype)
    b = torch.randn(n, generator=generator, dtype=dtype)
    residuals = []
    for k in range(8):
        u, info = prdp.linear_solve(a, b, prdp.GMRES(k, restart=m, rtol=0.0))
        assert torch.isfinite(u).all()
        residuals.append(info.residual.item())
    assert all(after <= before for before, after in pairwise(residuals))
    largest, smallest = torch.linalg.svdvals(a)[[0, rank - 1]]
    assert u.norm() <= b.norm() * max(1e3 / smallest, 1 / (largest * torch.finfo(dtype).eps))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_cpu_loops_equal_the_plain_tensors(dtype):
    a, b = nonsymmetric(4, 19).to(dtype), right_hand_sides(4, 19).to(dtype)
    for k, m in ((1, 1), (3, 4), (2, 30)):
        u, info = prdp.linear_solve(a, b, prdp.GMRES(k, restart=m, rtol=0.0))
        v, report = _C.solve_with_tensors(b, [a], "dense", [], [], False, "gmres", k, 0.0, m)
        np.testing.assert_allclose(u, v, rtol=0, atol=50 * torch.finfo(dtype).eps * v.abs().max())
        assert info.iterations.tolist() == report[0].tolist()


def test_a02_needs_a_space_of_two():
    u, info = solve("A02", prdp.GMRES(50, restart=1))
    assert statuses(info) == ["STAGNATED"] and info.residual.tolist() == [1.0] and torch.equal(u, torch.zeros_like(u))
    u, info = solve("A02", prdp.GMRES(50, restart=2))
    assert statuses(info) == ["CONVERGED_BREAKDOWN"] and info.iterations.tolist() == [1]
    np.testing.assert_allclose(u, F["A02__u"])


def test_a03_a_cyclic_shift_needs_the_whole_space_and_a_larger_restart_is_clipped():
    for m in (1, 3, 7):
        _, info = solve("A03", prdp.GMRES(50, restart=m))
        assert statuses(info) == ["STAGNATED"] and info.residual.tolist() == [1.0]
    for m in (8, 50):
        u, info = solve("A03", prdp.GMRES(50, restart=m))
        assert statuses(info) == ["CONVERGED_BREAKDOWN"] and info.iterations.tolist() == [1]
        np.testing.assert_allclose(u, F["A03__u"], atol=1e-14)


def test_a09_a_singular_consistent_system_gets_its_minimum_norm_solution():
    u, info = solve("A09_16", prdp.GMRES(50, restart=16, rtol=1e-10))
    assert (info.status > 0).all()
    expected = np.linalg.lstsq(F["A09_16__A"], F["A09_16__b"], rcond=None)[0]
    np.testing.assert_allclose(u, expected, atol=1e-10)


def test_a_singular_inconsistent_system_breaks_down_with_the_least_residual():
    a = torch.diag(torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64))
    u, info = prdp.linear_solve(a, torch.ones(3, dtype=torch.float64), prdp.GMRES(50, restart=3), on_failure="return")
    assert statuses(info) == ["BREAKDOWN"] and info.residual.item() == pytest.approx(3**-0.5)
    np.testing.assert_allclose(u[:2], [1.0, 0.5], rtol=1e-12)
    with pytest.raises(torch.linalg.LinAlgError, match="BREAKDOWN"):
        prdp.linear_solve(a, torch.ones(3, dtype=torch.float64), prdp.GMRES(50, restart=3))


@pytest.mark.parametrize("tensors", [False, True], ids=["loops", "tensors"])
def test_a_matrix_of_condition_2e6_is_solved_as_far_as_float32_goes(tensors):
    """Nonnormal, with ε ‖A‖ ‖u‖ a tenth of ‖b‖ and more, where Direct reaches 1e-2."""
    for seed in range(150):
        generator = torch.Generator().manual_seed(seed)
        left, right = (torch.linalg.qr(torch.randn(8, 8, generator=generator, dtype=torch.float64))[0] for _ in "ab")
        matrix = (left @ torch.diag(torch.logspace(0, -6.3, 8, dtype=torch.float64)) @ right).float()
        a = operators.Function(lambda v, m: v @ m.mT, tensors=matrix) if tensors else operators.Matrix(matrix)
        b = torch.randn(1, 8, generator=generator)
        u, info = prdp.linear_solve(a, b, prdp.GMRES(20, restart=8, rtol=1e-6), on_failure="return")
        true = (b.double() - u.double() @ matrix.double().mT).norm() / b.norm()
        assert info.residual.item() < 0.2 and true < 0.2, (seed, info.residual.item(), true.item())


def test_exactly_k_cycles_past_exact_convergence():
    a, b = nonsymmetric(2, 6), right_hand_sides(2, 6)
    u, info = prdp.linear_solve(a, b, prdp.GMRES(40, restart=6, rtol=0.0))
    assert info.iterations.tolist() == [40, 40]
    np.testing.assert_allclose(u, np.linalg.solve(a, b[..., None])[..., 0], rtol=1e-12)


def test_a_large_and_a_small_scale_pass_through():
    a, b = nonsymmetric(1, 9), right_hand_sides(1, 9)
    u, info = prdp.linear_solve(a, b, prdp.GMRES(3, restart=2))
    for k in (-900, 900):
        v, other = prdp.linear_solve(a, b * 2.0**k, prdp.GMRES(3, restart=2))
        assert torch.equal(v, u * 2.0**k) and torch.equal(other.residual, info.residual)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_unrolled_is_the_derivative_of_the_cycles_that_ran(m):
    a, b = nonsymmetric(2, 5, shift=2.0).requires_grad_(), right_hand_sides(2, 5).requires_grad_()

    def run(a, b):
        return prdp.linear_solve(a, b, prdp.GMRES(2, restart=m, rtol=0.0), backward="unrolled")[0]

    assert torch.autograd.gradcheck(run, (a, b))
    assert torch.autograd.gradgradcheck(run, (a[:1].detach().requires_grad_(), b[:1].detach().requires_grad_()))
    # Scaling A and b together changes nothing: ⟨b̄, b⟩ = ⟨ū, u⟩ = -⟨Ā, A⟩.
    u = run(a, b)
    g = torch.ones_like(u)
    grad_a, grad_b = torch.autograd.grad(u, (a, b), g)
    assert (grad_b * b).sum().item() == pytest.approx((g * u).sum().item(), rel=1e-9)
    assert (grad_a * a).sum().item() == pytest.approx(-(g * u).sum().item(), rel=1e-9)


def test_at_convergence_both_derivatives_are_exact():
    a, b = nonsymmetric(2, 12), right_hand_sides(2, 12)
    g = right_hand_sides(2, 12, seed=2)
    exact = torch.linalg.solve(a.mT, g)
    for backward in ("implicit", "unrolled"):
        x = b.clone().requires_grad_()
        u, info = prdp.linear_solve(a, x, prdp.GMRES(200, restart=5, rtol=1e-12), backward=backward)
        u.backward(g)
        np.testing.assert_allclose(x.grad, exact, rtol=0, atol=1e-9)
        if backward == "implicit":
            assert (info.adjoint.status > 0).all()


def test_on_a_stencil_it_meets_the_direct_solution():
    shape = (9, 14)
    a = operators.Heat(shape, 1e-3, 1.0)
    b = torch.randn(2, 1, *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    u, _ = prdp.linear_solve(a, b, prdp.GMRES(300, restart=6, rtol=1e-12))
    np.testing.assert_allclose(u, prdp.linear_solve(a, b, prdp.Direct())[0], atol=1e-10)


@pytest.mark.parametrize(
    "make, error, message",
    [
        (lambda: prdp.GMRES(3, restart=0), ValueError, "GMRES: restart must be >= 1, got 0"),
        (lambda: prdp.GMRES(3, restart=2.0), TypeError, "GMRES: restart must be a whole number, got 2.0"),
        (lambda: prdp.GMRES(-1), ValueError, "GMRES: max_iter must be >= 0, got -1"),
    ],
)
def test_bad_settings(make, error, message):
    with pytest.raises(error, match=message):
        make()
