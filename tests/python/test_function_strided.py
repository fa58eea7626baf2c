"""GMRES of a Function whose right-hand side, cotangent or products are strided."""

import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators


def matrix(n, dtype):
    a = torch.randn(n, n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (a + 3 * n**0.5 * torch.eye(n, dtype=torch.float64)).to(dtype)


def strided(*shape, dtype, seed=1):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype).mT


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("solver", [
    prdp.GMRES(20, restart=10), prdp.GMRES(1, 0.0, restart=40), prdp.BiCGStab(200), prdp.MINRES(200),
    prdp.CG(200),
], ids=str)  # fmt: skip
def test_solutions_and_gradients(solver, dtype):
    n, m = 7, 5
    a = matrix(m, dtype)
    if isinstance(solver, (prdp.CG, prdp.MINRES)):
        a = a @ a.mT
    b = strided(3, m, n, dtype=dtype)  # (3, n, m)
    leaf = a.clone().requires_grad_()
    operator = operators.Function(lambda v, a: (a @ v.mT).mT, lambda v, a: (a.mT @ v.mT).mT, tensors=leaf)
    solver.rtol = 0.0 if solver.rtol == 0.0 else 10 * torch.finfo(dtype).eps
    u, _ = prdp.linear_solve(operator, b, solver, on_failure="return")
    expected = torch.linalg.solve(a.double(), b.double().mT).mT
    tolerance = {"rtol": 1e-4, "atol": 1e-4} if dtype == torch.float32 else {"rtol": 1e-9, "atol": 1e-9}
    torch.testing.assert_close(u.double(), expected, **tolerance)
    weight = torch.randn(3, m, n, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    (found,) = torch.autograd.grad((u.mT * weight.to(dtype)).sum(), leaf)
    exact = a.double().requires_grad_()
    (wanted,) = torch.autograd.grad((torch.linalg.solve(exact, b.double().mT) * weight).sum(), exact)
    torch.testing.assert_close(found.double(), wanted, **tolerance)


def test_a_preconditioner_may_give_strided_vectors():
    kappa = 1 + torch.rand(2, 5, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    b = strided(2, 1, 6, 5, dtype=torch.float64)
    own = operators.Function(lambda v: (0.01 * v).mT.contiguous().mT)
    u, _ = prdp.linear_solve(operators.Diffusion(kappa), b, prdp.GMRES(20, 1e-10, preconditioner=own))
    exact, _ = prdp.linear_solve(operators.Diffusion(kappa), b.contiguous(), prdp.Direct())
    torch.testing.assert_close(u, exact, rtol=1e-7, atol=1e-9)


def test_a_sample_that_has_ended_is_handed_zeros():
    """While its neighbours go on: a product that is not finite elsewhere must not spoil it."""
    seen = []

    def product(v):
        seen.append(v.clone())
        return torch.tensor([[1.0, 2.0, 3.0, 4.0]], dtype=v.dtype) * v

    b = torch.tensor([[0.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]], dtype=torch.float64)
    a = operators.Function(product)
    prdp.linear_solve(a, b, prdp.GMRES(5, 1e-10, restart=4))
    seen.clear()
    u, info = prdp.linear_solve(a, b, prdp.GMRES(5, 1e-10, restart=4))
    torch.testing.assert_close(u, b / torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=b.dtype))
    assert info.operator_applications[0] < info.operator_applications[1]
    assert sum(bool((v[0] == 0).all() and (v[1] != 0).any()) for v in seen) >= 2
