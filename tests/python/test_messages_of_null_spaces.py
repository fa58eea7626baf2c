"""What is said where A or Aᵀ maps the constant to zero, and how much of a mean is rounding."""

import pytest
import torch
from helpers import random

import prdp_torch as prdp
from prdp_torch import operators


def transport(n=30):
    """Mass is conserved, Aᵀ 1 = 0, but A 1 is not zero."""
    a = torch.zeros(n, n, dtype=torch.float64)
    for i in range(n - 1):
        a[i, i] += 2.5
        a[i + 1, i] -= 2.5
        a[i, i + 1] -= 1
        a[i + 1, i + 1] += 1
    return a


LEFT = 'left_nullspace="constant", and as nullspace the vector that A maps to zero'
RIGHT = 'nullspace="constant", and as left_nullspace the vector that Aᵀ maps to zero'


def test_of_a_b_with_a_mean():
    with pytest.raises(torch.linalg.LinAlgError, match=f"as Aᵀ maps the constant to zero; .* null spaces: {LEFT}"):
        prdp.linear_solve(transport(), random(1, 30, seed=1) + 1, prdp.BiCGStab(500, 1e-9))


def test_of_an_adjoint_solve():
    b = random(1, 30, seed=1)
    b = (b - b.mean()).requires_grad_()
    u, _ = prdp.linear_solve(transport(), b, prdp.BiCGStab(500, 1e-9))
    said = f"adjoint solve: .*Aᵀ maps the constant to zero, so A is singular; name both null spaces: {LEFT}"
    with pytest.raises(torch.linalg.LinAlgError, match=said):
        u.backward(random(1, 30, seed=2))


def test_of_a_right_null_space():
    said = f"A maps the constant to zero, so it is singular; name both null spaces: {RIGHT}"
    with pytest.raises(torch.linalg.LinAlgError, match=said):
        prdp.linear_solve(transport().mT, random(1, 30, seed=1), prdp.BiCGStab(500, 1e-9))


@pytest.mark.parametrize("offset", [0.0, 10.0, 1e3, 1e5])
def test_what_is_left_of_a_mean_is_rounding_in_float64(offset):
    a = operators.Diffusion(torch.ones(1, 32, 32).double(), boundary="flux")
    b = random(3, 1, 32, 32) + offset
    b = b - b.mean((1, 2, 3), keepdim=True)
    for solver in (prdp.CG(30, rtol=0.0), prdp.CG(500, rtol=1e-9), prdp.Direct()):
        _, info = prdp.linear_solve(a, b, solver)
        assert not info.failed.any()
    with pytest.raises(torch.linalg.LinAlgError, match="lies outside the range of A; take the mean off b"):
        prdp.linear_solve(a, b + 1e-6, prdp.CG(30, rtol=0.0))


def test_in_float32_the_mean_is_to_be_taken_off_once_more():
    a = operators.Diffusion(torch.ones(1, 32, 32), boundary="flux")
    b = random(1, 1, 32, 32).float() + 1e4
    b = b - b.mean()
    with pytest.raises(torch.linalg.LinAlgError, match="take the mean off b; if you did, take it off again"):
        prdp.linear_solve(a, b, prdp.CG(500))
    assert prdp.linear_solve(a, b - b.mean(), prdp.CG(500))[1].solved.all()


def test_multigrid_alone_in_float32_is_not_sent_to_gmres(always):
    torch.manual_seed(0)
    a, b = operators.Diffusion(torch.full((1, 341), 10.0), shift=0.1, boundary="flux"), torch.randn(1, 1, 341)
    with pytest.raises(torch.linalg.LinAlgError, match="take CG with multigrid, Direct or float64"):
        prdp.linear_solve(a, b, prdp.Multigrid(300, 1e-4))
    with pytest.warns(UserWarning, match="STAGNATED"):
        u, _ = prdp.linear_solve(a, b, prdp.CG(300, 1e-4, preconditioner="multigrid"))
    exact = prdp.linear_solve(operators.Diffusion(a.kappa.double(), 0.1, "flux"), b.double(), prdp.Direct())[0]
    torch.testing.assert_close(u.double(), exact, rtol=1e-4, atol=1e-4)
