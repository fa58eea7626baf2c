"""Chebyshev's semi-iteration: against its polynomial on the dense matrix, in both ways through a batch."""

import numpy as np
import pytest
import torch
from helpers import dense_heat, dense_laplacian, field, statuses
from numpy.polynomial import chebyshev
from torch.autograd import gradcheck, gradgradcheck

import prdp_torch as prdp
from prdp_torch import _C, operators

SHAPES = [(1,), (7,), (30,), (70,), (200,), (5, 8), (30, 30), (3, 90), (4, 3, 6), (20, 20, 20)]
OPERATORS = {"heat": lambda s: operators.Heat(s, 1e-3, 1.0), "poisson": operators.Poisson}


def polynomial(matrix, b, k):
    """(u_K, A⁻¹b): its error is T_K(G/ρ) / T_K(1/ρ) times that of zero, with the iteration matrix G of Jacobi."""
    d = matrix[0, 0]
    mu, q = np.linalg.eigh(np.eye(len(matrix)) - matrix / d)
    rho = np.abs(mu).max()  # 0 for a single unknown
    exact = np.linalg.solve(matrix, b.T).T
    t = chebyshev.Chebyshev.basis(k)
    left = t(mu / rho) / t(1 / rho) if rho > 0 else mu**k
    return exact - ((exact @ q) * left) @ q.T, exact


@pytest.mark.parametrize("shape", [s for s in SHAPES if np.prod(s) < 1000])
@pytest.mark.parametrize("name", OPERATORS)
@pytest.mark.parametrize("k", [0, 1, 2, 3, 8, 21])
def test_iterates_are_those_of_the_polynomial(shape, name, k):
    b = field(shape, batch=3)
    matrix = dense_heat(shape) if name == "heat" else dense_laplacian(shape)
    expected, exact = polynomial(matrix, b.flatten(1).numpy(), k)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-5)):
        u, info = prdp.linear_solve(OPERATORS[name](shape), b.to(dtype), prdp.Chebyshev(k, rtol=0.0))
        error = np.abs(u.flatten(1).numpy() - expected).max()
        assert error <= tolerance * np.abs(exact).max()
        assert info.iterations.tolist() == [k] * 3
        assert info.operator_applications.tolist() == [max(k - 1, 0) + 1] * 3


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("rtol", [0.0, 1e-5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cpu_loops_and_plain_tensors_agree(shape, rtol, dtype):
    a = operators.Heat(shape, 1e-3, 1.0)
    b = field(shape, batch=3, dtype=dtype)
    u, info = prdp.linear_solve(a, b, prdp.Chebyshev(12, rtol=rtol), on_failure="return")
    v, report = _C.solve_with_tensors(b, a.tensors, a.kind, a.shape, a.parameters, False, "chebyshev", 12, rtol)
    torch.testing.assert_close(u, v, rtol=0, atol=200 * torch.finfo(dtype).eps * v.abs().max().item())
    assert info.iterations.tolist() == report[0].tolist()
    if rtol > 0:  # else rounding decides whether a residual of zero is met
        assert info.status.tolist() == report[2].tolist()
    assert info.operator_applications.tolist() == report[3].tolist()


@pytest.mark.parametrize("shape, nu", [((30,), 1e-3), ((30, 30), 1e-3), ((20, 20, 20), 1e-2)])
def test_stops_at_the_tolerance_in_less_than_two_thirds_of_jacobis_iterations(shape, nu):
    a, b = operators.Heat(shape, nu, 1.0), field(shape, batch=4)
    u, info = prdp.linear_solve(a, b, prdp.Chebyshev(500, rtol=1e-6))
    assert statuses(info) == ["CONVERGED"] * 4
    residual = (b - a.apply(u)).flatten(1).norm(dim=1) / b.flatten(1).norm(dim=1)
    assert (residual <= 1e-6).all()
    for i, count in enumerate(info.iterations.tolist()):
        _, earlier = prdp.linear_solve(a, b[i : i + 1], prdp.Chebyshev(count - 1, rtol=0.0))
        assert earlier.residual.item() > 1e-6  # so it is the first iteration that meets it
    _, jacobi = prdp.linear_solve(a, b, prdp.Jacobi(2000, rtol=1e-6))
    assert (3 * info.iterations < 2 * jacobi.iterations).all()


@pytest.mark.parametrize("shape", [(5,), (3, 2), (2, 1, 3)])
@pytest.mark.parametrize("backward, k, rtol", [("implicit", 200, 1e-14), ("unrolled", 1, 0.0), ("unrolled", 6, 0.0)])
def test_derivatives(shape, backward, k, rtol):
    nu = torch.tensor(2e-3, dtype=torch.float64, requires_grad=True)
    b = field(shape).requires_grad_()

    def solve(b, nu):
        solver = prdp.Chebyshev(k, rtol=rtol)
        return prdp.linear_solve(operators.Heat(shape, nu, 1.0), b, solver, backward=backward, on_failure="return")[0]

    assert gradcheck(solve, (b, nu))
    assert gradgradcheck(solve, (b, nu))


def test_the_unrolled_gradient_of_b_is_as_many_iterations_with_the_transpose():
    a, b, g = operators.Poisson((9, 7)), field((9, 7)).requires_grad_(), field((9, 7), seed=1)
    u, _ = prdp.linear_solve(a, b, prdp.Chebyshev(11, rtol=0.0), backward="unrolled")
    u.backward(g)
    transposed, _ = prdp.linear_solve(a, g, prdp.Chebyshev(11, rtol=0.0))
    torch.testing.assert_close(b.grad, transposed, rtol=0, atol=1e-14)


def test_a_sample_of_nan_leaves_its_neighbours_alone():
    a, b = operators.Heat((30, 30), 1e-3, 1.0), field((30, 30), batch=3, dtype=torch.float32)
    alone, _ = prdp.linear_solve(a, b, prdp.Chebyshev(15))
    b[1, 0, 3, 4] = torch.nan
    u, info = prdp.linear_solve(a, b, prdp.Chebyshev(15), on_failure="return")
    assert statuses(info)[1] == "NONFINITE_INPUT" and (u[1] == 0).all()
    assert torch.equal(u[0], alone[0]) and torch.equal(u[2], alone[2])


@pytest.mark.parametrize("operator", [torch.eye(4), operators.Burgers(torch.ones(1, 1, 4), 1e-2, 0.1)])
@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_operators_of_unknown_spectrum_are_refused_by_name(operator, backward):
    b = torch.ones(1, 4) if isinstance(operator, torch.Tensor) else torch.ones(1, 1, 4)
    with pytest.raises(ValueError, match="Chebyshev: the spectrum is known of Heat and Poisson operators alone"):
        prdp.linear_solve(operator, b.requires_grad_(), prdp.Chebyshev(3), backward=backward)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("k", [1, 2, 3, 40, 64, 65, 130])
def test_each_sample_has_the_weights_of_its_own_spectrum(k, dtype):
    nu = torch.tensor([1e-3, 0.1, 1e-2, 0.1], dtype=dtype)
    b = field((9, 7), batch=4, dtype=dtype)
    u, info = prdp.linear_solve(operators.Heat((9, 7), nu, 1.0), b, prdp.Chebyshev(k, rtol=0.0))
    for i in range(4):
        alone, _ = prdp.linear_solve(
            operators.Heat((9, 7), nu[i : i + 1], 1.0), b[i : i + 1], prdp.Chebyshev(k, rtol=0.0)
        )
        assert torch.equal(u[i], alone[0])
        expected, exact = polynomial(dense_heat((9, 7), float(nu[i])), b[i].flatten(1).double().numpy(), k)
        error = np.abs(u[i].flatten(1).numpy() - expected).max()
        assert error <= 1e3 * torch.finfo(dtype).eps * np.abs(exact).max()
    _, info = prdp.linear_solve(operators.Heat((9, 7), nu, 1.0), b, prdp.Chebyshev(500, rtol=1e-4))
    assert info.iterations[1] == pytest.approx(info.iterations[3], abs=3)
