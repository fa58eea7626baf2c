"""Derivatives of solves: each mode against what it defines, all in float64."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import ITERATIVE, SOLVERS, dense_heat, dense_laplacian, field, golden, spd_matrices
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp
from prdp_torch import operators

# name: (operator out of its tensors, the tensors, shape of one right-hand side)
OPERATORS = {
    "poisson_1d": (lambda: operators.Poisson((5,)), (), (1, 5)),
    "poisson_2d": (lambda: operators.Poisson((3, 2)), (), (1, 3, 2)),
    "poisson_3d": (lambda: operators.Poisson((2, 1, 3)), (), (1, 2, 1, 3)),
    "heat_1d": (lambda nu: operators.Heat((5,), nu, 1.0), (2e-3,), (1, 5)),
    "heat_2d": (lambda nu: operators.Heat((3, 2), nu, 1.0), (2e-3,), (1, 3, 2)),
    "heat_3d": (lambda nu: operators.Heat((2, 2, 2), nu, 1.0), (2e-3,), (1, 2, 2, 2)),
    "dense": (operators.Matrix, (spd_matrices(1, 4)[0],), (4,)),
    "dense_batched": (operators.Matrix, (spd_matrices(2, 3),), (3,)),
}


def case(name):
    make, tensors, shape = OPERATORS[name]
    tensors = [torch.as_tensor(t, dtype=torch.float64).clone().requires_grad_() for t in tensors]
    generator = torch.Generator().manual_seed(4)
    b = torch.randn(2, *shape, generator=generator, dtype=torch.float64, requires_grad=True)
    return make, [b, *tensors]


@pytest.mark.parametrize("name", OPERATORS)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_converged_solves_pass_gradcheck_and_gradgradcheck(name, solver, backward):
    make, inputs = case(name)

    # CG and MINRES all but end on so small a system: iterations beyond would work, and be differentiated, on a
    # residual of rounding errors.
    rtol = 1e-6 if solver in (prdp.CG, prdp.MINRES) and backward == "unrolled" else 1e-14

    def solve(b, *tensors):
        return prdp.linear_solve(make(*tensors), b, solver(400, rtol=rtol), backward=backward)[0]

    assert gradcheck(solve, inputs)
    assert gradgradcheck(solve, inputs)


@pytest.mark.parametrize("name", OPERATORS)
@pytest.mark.parametrize("solver", ITERATIVE)
@pytest.mark.parametrize("k", [1, 2])
def test_unrolled_is_the_exact_derivative_of_k_iterations(name, solver, k):
    make, inputs = case(name)

    def solve(b, *tensors):
        return prdp.linear_solve(make(*tensors), b, solver(k, rtol=0.0), backward="unrolled")[0]

    assert gradcheck(solve, inputs)
    assert gradgradcheck(solve, inputs)


@pytest.mark.filterwarnings("ignore:linear_solve. the gradient of a sparse CSR tensor")
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("batched", [False, True])
def test_gradients_of_sparse_matrices_live_on_their_pattern(solver, batched):
    m = spd_matrices(2, 4)
    m[:, 0, 3] = m[:, 3, 0] = 0.0
    m = m if batched else m[0]
    b = torch.randn(2, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    for backward in ("implicit", "unrolled"):
        dense, sparse = m.clone().requires_grad_(), m.to_sparse_csr().requires_grad_()
        right, other = b.clone().requires_grad_(), b.clone().requires_grad_()
        for a, rhs in ((dense, right), (sparse, other)):
            u, _ = prdp.linear_solve(a, rhs, solver(300, rtol=1e-14), backward=backward)
            (u**2).sum().backward()
        torch.testing.assert_close(other.grad, right.grad)
        assert sparse.grad.layout == torch.sparse_csr
        torch.testing.assert_close(sparse.grad.to_dense(), dense.grad * (m != 0))


@pytest.mark.parametrize("name, shape, ks", [("heat1d", (30,), (1, 5, 25)), ("heat2d", (30, 30), (1, 5, 25, 43))])
def test_gradients_equal_the_published_code(name, shape, ks):
    g = golden(name)
    w = torch.tensor(g["w"]).view(3, 1, *shape)

    def gradient(solver, backward):
        u = torch.tensor(g["u"]).view(3, 1, *shape).requires_grad_()
        prdp.Heat(shape, 1e-3, 1.0, solver=solver, backward=backward)(u).backward(w)
        return u.grad.flatten(1)

    for backward in ("implicit", "unrolled"):
        np.testing.assert_allclose(gradient(prdp.Direct(), backward), g["grad_direct"], rtol=0, atol=1e-10)
        for k in ks:  # Jacobi from zero is linear in b: both modes agree at every K
            result = gradient(prdp.Jacobi(k, rtol=0.0), backward)
            np.testing.assert_allclose(result, g[f"grad_jacobi_K{k}"], rtol=0, atol=1e-10)
    for k in ks:
        result = gradient(prdp.SteepestDescent(k, rtol=0.0), "unrolled")
        np.testing.assert_allclose(result, g[f"grad_sd_unrolled_K{k}"], rtol=0, atol=1e-10)


@pytest.mark.parametrize("solver", ITERATIVE)
@pytest.mark.parametrize("k", [1, 3, 6])
def test_implicit_is_the_adjoint_solve_truncated_at_the_same_k(solver, k):
    nu = torch.tensor(2e-3, dtype=torch.float64, requires_grad=True)
    b, g = field((8,)).requires_grad_(), field((8,), seed=3)
    u, info = prdp.linear_solve(operators.Heat((8,), nu, 1.0), b, solver(k, rtol=0.0))
    u.backward(g)
    # A is symmetric, so the adjoint solve is the primal one with another right-hand side.
    lam, _ = prdp.linear_solve(operators.Heat((8,), 2e-3, 1.0), g, solver(k, rtol=0.0))
    torch.testing.assert_close(b.grad, lam, rtol=1e-13, atol=1e-15)
    product = u.detach().flatten(1).numpy() @ dense_laplacian((8,)).T
    np.testing.assert_allclose(nu.grad, (lam.flatten(1).numpy() * product).sum(), rtol=1e-12)
    assert info.adjoint.iterations.tolist() == [k, k]


def test_implicit_on_a_nonsymmetric_matrix_solves_with_the_transpose():
    m = torch.tensor([[4.0, 1.0, 0.0], [-2.0, 5.0, 1.0], [0.5, 0.0, 3.0]], dtype=torch.float64)
    g = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    for layout in (m, m.to_sparse_csr()):
        for solver in (prdp.Jacobi(300, rtol=1e-15), prdp.Direct()):
            b = torch.ones(3, dtype=torch.float64, requires_grad=True)
            prdp.linear_solve(layout, b, solver)[0].backward(g)
            torch.testing.assert_close(b.grad, torch.linalg.solve(m.mT, g), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("solver", SOLVERS)
def test_unrolled_gradients_satisfy_eulers_identities(solver):
    """u_K is homogeneous of degree 1 in b and -1 in A: ⟨b̄, b⟩ = ⟨g, u_K⟩ = -⟨Ā, A⟩ at any K."""
    m = spd_matrices(1, 6)[0].requires_grad_()
    b, g = field((6,))[:, 0].requires_grad_(), field((6,), seed=9)[:, 0]
    u, _ = prdp.linear_solve(m, b, solver(3, rtol=0.0), backward="unrolled")
    u.backward(g)
    expected = float((g * u.detach()).sum())
    assert float((b.grad * b.detach()).sum()) == pytest.approx(expected, rel=1e-11)
    assert float((m.grad * m.detach()).sum()) == pytest.approx(-expected, rel=1e-11)


def test_modes_differ_below_convergence_and_meet_at_it():
    g = field((12,), seed=2)

    def gradient(k, backward):
        b = field((12,)).requires_grad_()
        prdp.Heat((12,), 1e-3, 1.0, solver=prdp.SteepestDescent(k, rtol=0.0), backward=backward)(b).backward(g)
        return b.grad

    gaps = [float((gradient(k, "implicit") - gradient(k, "unrolled")).norm()) for k in (1, 4, 16, 60)]
    assert gaps[0] > 1e-2
    assert all(after < before for before, after in pairwise(gaps))
    assert gaps[-1] < 1e-12


def test_none_gives_no_gradient():
    b = field((9,)).requires_grad_()
    assert not prdp.Heat((9,), 1e-3, 1.0, solver=prdp.Jacobi(3), backward="none")(b).requires_grad


def test_adjoint_has_its_own_budget_and_tolerance():
    heat = prdp.Heat((20,), 1e-3, 1.0, solver=prdp.Jacobi(50), adjoint_max_iter=3)
    b = field((20,)).requires_grad_()
    heat(b).sum().backward()
    assert heat.adjoint_info.iterations.tolist() == [3, 3] and (heat.info.iterations > 3).all()
    heat = prdp.Heat((20,), 1e-3, 1.0, solver=prdp.Jacobi(50), adjoint_rtol=1e-1)
    heat(b).sum().backward()
    assert (heat.adjoint_info.iterations < heat.info.iterations).all()


def test_a_tiny_cotangent_gets_the_same_relative_accuracy():
    b = field((30,), dtype=torch.float32).requires_grad_()
    g = field((30,), seed=8, dtype=torch.float32)
    gradients = []
    for scale in (1.0, 1e-13, 1e-30):
        b.grad = None
        prdp.Heat((30,), 1e-3, 1.0, solver=prdp.Jacobi(100))(b).backward(g * scale)
        gradients.append(b.grad / scale)
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradients[2], gradients[0], rtol=1e-4, atol=1e-5)


def test_a_zero_cotangent_in_the_batch_gives_a_zero_gradient():
    b = field((30,)).requires_grad_()
    g = field((30,), seed=8)
    g[0] = 0.0
    for solver in SOLVERS:
        for backward in ("implicit", "unrolled"):
            b.grad = None
            prdp.Heat((30,), 1e-3, 1.0, solver=solver(20), backward=backward)(b).backward(g)
            assert torch.equal(b.grad[0], torch.zeros_like(b.grad[0])) and b.grad[1].abs().max() > 0


def test_a_rollout_of_steps_passes_gradcheck():
    heat = prdp.Heat((6,), 1e-3, 1.0, solver=prdp.CG(100, rtol=1e-14))
    assert gradcheck(lambda u: heat(heat(heat(u))), field((6,)).requires_grad_())


def test_implicit_mode_keeps_u_only():
    """What autograd keeps of a solve: u where A has a derivative, nothing of b's size where not."""

    def kept(nu, backward):
        sizes = []
        b = field((40,)).requires_grad_()
        with torch.autograd.graph.saved_tensors_hooks(lambda t: sizes.append(t.numel()) or t, lambda t: t):
            prdp.linear_solve(operators.Heat((40,), nu, 1.0), b, prdp.Jacobi(50), backward=backward)
        return sum(n for n in sizes if n >= b.numel())

    unknowns = 2 * 40
    assert kept(1e-3, "implicit") == 0
    assert kept(torch.tensor(1e-3, requires_grad=True), "implicit") == unknowns
    assert kept(1e-3, "unrolled") == unknowns


def test_the_direct_solver_differentiates_like_lapack():
    nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    b = field((4, 5)).requires_grad_()
    g = field((4, 5), seed=1)
    prdp.linear_solve(operators.Heat((4, 5), nu, 1.0), b, prdp.Direct())[0].backward(g)
    other_nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    other_b = b.detach().clone().requires_grad_()
    laplacian = torch.tensor(dense_laplacian((4, 5)))
    a = torch.eye(20, dtype=torch.float64) - other_nu * laplacian
    torch.linalg.solve(a, other_b.flatten(1).mT).mT.reshape(b.shape).backward(g)
    torch.testing.assert_close(b.grad, other_b.grad, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(nu.grad, other_nu.grad, rtol=1e-10, atol=1e-10)
    assert np.linalg.cond(dense_heat((4, 5))) < 1e3


def test_gradients_in_float32_are_close_to_float64():
    for solver in SOLVERS:
        for backward in ("implicit", "unrolled"):
            gradients = []
            for dtype in (torch.float64, torch.float32):
                b = field((30,)).to(dtype).requires_grad_()
                heat = prdp.Heat((30,), 1e-3, 1.0, solver=solver(10, rtol=0.0), backward=backward)
                (heat(b) ** 2).sum().backward()
                gradients.append(b.grad.double())
            torch.testing.assert_close(gradients[1], gradients[0], rtol=2e-4, atol=2e-5)
