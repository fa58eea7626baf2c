"""The first cycle of GMRES ends at a tenth of rtol, in every way that a solve may run."""

import numpy as np
import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators

F64 = torch.float64
N = 40


def system(batch=3, seed=0):
    """Matrices, and preconditioners that come the nearer to their inverses the later the sample."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(batch, N, N, generator=generator, dtype=F64) + 8 * torch.eye(N, dtype=F64)
    noise = torch.randn(batch, N, N, generator=generator, dtype=F64)
    off = torch.tensor([3e-2, 3e-3, 3e-4], dtype=F64)[:batch].reshape(-1, 1, 1)
    inverse = torch.linalg.inv(a) @ (torch.eye(N, dtype=F64) + off * noise)
    return a, inverse, torch.randn(batch, N, generator=generator, dtype=F64)


def products_needed(a, inverse, b, rtol):
    """How many columns the least residual over the Krylov space takes to fall below this, by NumPy."""
    a, inverse, b = a.numpy(), inverse.numpy(), b.numpy()
    basis = [b / np.linalg.norm(b)]
    for columns in range(1, N):
        v = a @ inverse @ basis[-1]
        image = np.stack([a @ inverse @ w for w in basis], 1)
        left = np.linalg.norm(b - image @ np.linalg.lstsq(image, b, rcond=None)[0])
        if left < rtol * np.linalg.norm(b):
            return columns
        v -= np.stack(basis, 1) @ (np.stack(basis, 1).T @ v)
        v -= np.stack(basis, 1) @ (np.stack(basis, 1).T @ v)
        basis.append(v / np.linalg.norm(v))
    return N


def by_matmul(m):
    return operators.Function(lambda v, m: (m * v.unsqueeze(-2)).sum(-1), tensors=m)


@pytest.mark.parametrize("rtol", [1e-3, 1e-8])
def test_with_a_strong_preconditioner_a_long_cycle_takes_the_products_that_it_needs(rtol):
    a, inverse, b = system()
    solver = prdp.GMRES(5, restart=30, rtol=rtol, preconditioner=by_matmul(inverse))
    u, info = prdp.linear_solve(a, b, solver)
    needed = torch.tensor([products_needed(a[i], inverse[i], b[i], rtol / 10) for i in range(3)])
    assert info.iterations.tolist() == [1, 1, 1]
    assert torch.equal(info.operator_applications, needed + 1), needed  # and the residual's
    assert (info.residual <= rtol / 9).all() and needed[0] > needed[2]
    torch.testing.assert_close((a @ u.unsqueeze(-1)).squeeze(-1), b, rtol=0, atol=rtol * float(b.norm(dim=1).max()))


@pytest.mark.parametrize("kind", ["matrix", "matrix with diagonal", "function", "own preconditioner"])
def test_a_sample_takes_as_many_products_alone_as_in_a_batch(kind):
    a, inverse, b = system()

    def solved(rows):
        operator = a[rows] if kind.startswith("matrix") else by_matmul(a[rows])
        own = by_matmul(inverse[rows]) if kind == "own preconditioner" else "diagonal" if "diagonal" in kind else None
        return prdp.linear_solve(operator, b[rows], prdp.GMRES(restart=12, rtol=1e-4, preconditioner=own, max_iter=9))

    u, info = solved(slice(0, 3))
    for i in range(3):
        alone, of_it = solved(slice(i, i + 1))
        assert torch.equal(alone[0], u[i])
        for name in ("operator_applications", "iterations", "status", "residual"):
            assert torch.equal(getattr(of_it, name)[0], getattr(info, name)[i]), name


def test_with_rtol_zero_every_cycle_is_whole():
    a, inverse, b = system()
    solver = prdp.GMRES(restart=10, max_iter=2, rtol=0.0, preconditioner=by_matmul(inverse))
    assert prdp.linear_solve(a, b, solver)[1].operator_applications.tolist() == [22, 22, 22]


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
@pytest.mark.parametrize("function", [False, True])
def test_gradients_of_a_cycle_that_ends_early(backward, function):
    """To the tolerance those of the solution, by loops, by their tape and by tensor operations."""
    a, _, b = system(batch=2)
    a += 30 * torch.eye(N, dtype=F64)
    a.requires_grad_(), b.requires_grad_()
    solver = prdp.GMRES(5, restart=N, rtol=1e-11)
    u, info = prdp.linear_solve(by_matmul(a) if function else a, b, solver, backward=backward)
    if backward == "implicit":
        assert (info.operator_applications < N).all()
    else:  # the derivative of the last products would be rounding
        assert (info.operator_applications >= N).all()
    weights = torch.cos(torch.arange(2.0 * N, dtype=F64)).reshape(2, N)
    found = torch.autograd.grad((u * weights).sum(), (a, b))
    expected = torch.autograd.grad((torch.linalg.solve(a, b) * weights).sum(), (a, b))
    for mine, true in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, true, rtol=1e-6, atol=1e-8 * float(true.abs().max()))


def test_an_exact_start_of_a_function_needs_no_cycle():
    """What is left is zero, and so is all that a cycle makes of it; rtol = 0 goes through the cycles all the same."""
    a = operators.Function(lambda v: 2 * v, symmetric=True)
    b = torch.randn(3, 2, generator=torch.Generator().manual_seed(0))
    u, info = prdp.linear_solve(a, b, prdp.GMRES(max_iter=10, rtol=0.0), x0=b)
    assert info.status.tolist() == [1, 1, 1] and torch.equal(u, b / 2)


@pytest.mark.parametrize("scale", [1e-200, 1e-20, 1e20, 1e200])
def test_the_floor_of_a_function_does_not_depend_on_its_scale(scale):
    """‖A‖ of a Function is estimated, and its square leaves the range of float64."""
    a = operators.Function(lambda v: scale * v, symmetric=True)
    b = torch.randn(50, 4, generator=torch.Generator().manual_seed(1), dtype=F64)
    _, info = prdp.linear_solve(a, b, prdp.GMRES(max_iter=50, rtol=1e-20))
    assert info.solved.all()


def test_a_long_restart_on_navier_stokes_does_not_break_down():
    """Once the space holds all that A reaches, rounding is all that a further cycle could work on."""
    for seed in range(40):
        generator = torch.Generator().manual_seed(seed)
        v, b = torch.randn(2, 1, 3, 4, 4, generator=generator, dtype=F64)
        b[:, 2] -= b[:, 2].mean()
        a = operators.NavierStokes(v, nu=0.05, dt=0.1)
        for rtol in (1e-5, 1e-12):
            assert prdp.linear_solve(a, b, prdp.GMRES(max_iter=60, restart=48, rtol=rtol))[1].solved.all(), seed


def test_second_derivatives_of_unrolled_cycles_are_those_of_differences():
    """Near an exhausted space the derivative of one more product is rounding: no cycle that is unrolled ends early."""
    scales = torch.logspace(0, 2, 14, dtype=F64)
    for seed in range(10):
        generator = torch.Generator().manual_seed(seed)
        a = torch.randn(14, 14, generator=generator, dtype=F64) + 6 * torch.eye(14, dtype=F64)
        a, b = a * scales[:, None], torch.randn(14, generator=generator, dtype=F64)
        along = torch.randn(14, 14, generator=generator, dtype=F64) * scales[:, None] * 0.1

        def f(t, a=a, b=b, along=along):
            solver = prdp.GMRES(1, rtol=0.1, restart=14)
            return prdp.linear_solve(a + t * along, b, solver, backward="unrolled")[0].square().sum()

        t = torch.zeros((), dtype=F64, requires_grad=True)
        (first,) = torch.autograd.grad(f(t), t, create_graph=True)
        (second,) = torch.autograd.grad(first, t)
        exact = [torch.linalg.solve(a + x * along, b).square().sum() for x in (-1e-3, 0.0, 1e-3)]
        torch.testing.assert_close(first.detach(), (exact[2] - exact[0]) / 2e-3, rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(second, (exact[2] - 2 * exact[1] + exact[0]) / 1e-6, rtol=1e-2, atol=1e-5)
