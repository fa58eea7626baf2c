"""Diffusion of which nothing holds u, though a tensor of zeros stands for its shift or for h of a side."""

import pytest
import torch
from fibers import Fibers

import prdp_torch as prdp
from prdp_torch.operators import Diffusion

F64 = torch.float64
SHAPE = 6, 5
KAPPA = 0.2 + torch.rand(3, *SHAPE, dtype=F64, generator=torch.Generator().manual_seed(0))
ZEROS = torch.zeros(3, *SHAPE, dtype=F64)
SOLVERS = [
    prdp.CG(200),
    prdp.CG(200, preconditioner="multigrid"),
    prdp.CG(200, preconditioner="diagonal"),
    prdp.Multigrid(50),
    prdp.MINRES(100),
    prdp.GMRES(50),
    prdp.Direct(),
]


def right_hand_side(seed=1):
    b = torch.randn(3, 1, *SHAPE, dtype=F64, generator=torch.Generator().manual_seed(seed))
    return b - b.mean((2, 3), keepdim=True)


def robin(h):
    return ("flux", (("robin", h), "flux"))


REFUSED = r"Diffusion: in sample 0 neither the shift nor a side holds u, so A is singular; .* give shift=0.0"
WAYS = {
    "field": lambda: Diffusion(KAPPA, ZEROS, "flux"),
    "numbers": lambda: Diffusion(KAPPA, ZEROS[:, :1, :1], ["flux", "periodic"]),
    "h": lambda: Diffusion(KAPPA, 0.0, robin(ZEROS[:, :, 0])),
    "both": lambda: Diffusion(KAPPA, ZEROS, robin(0.0)),
    "of all": lambda: Diffusion(KAPPA, ZEROS[:1], "periodic"),
    "a number in a tensor": lambda: Diffusion(KAPPA, torch.nn.Parameter(ZEROS[0, 0, 0].clone()), "flux"),
    "numbers in tensors": lambda: Diffusion(KAPPA, 0.0, robin(ZEROS[0, 0, 0].clone())),
    "per axis": lambda: Diffusion(torch.stack((KAPPA, KAPPA), 1), ZEROS, "flux", per_axis=True),
}


@pytest.mark.parametrize("name", WAYS)
def test_it_is_refused_before_any_work(name):
    for solver in SOLVERS:
        with pytest.raises(ValueError, match=REFUSED):
            prdp.linear_solve(WAYS[name](), right_hand_side(), solver)
        u, info = prdp.linear_solve(WAYS[name](), right_hand_side(), solver, on_failure="return")
        assert (info.status == -9).all() and not u.any()


@pytest.mark.parametrize("name", WAYS)
def test_on_a_device_it_fails_as_well(name):
    with Fibers(threads=32):
        u, info = prdp.linear_solve(WAYS[name](), right_hand_side(), prdp.CG(99), on_failure="return")
        with pytest.raises(ValueError, match=REFUSED):
            prdp.linear_solve(WAYS[name](), right_hand_side(), prdp.CG(99))
    assert info.way == "kernel" and (info.status == -9).all() and not u.any()


def test_an_operator_that_is_not_solved_with_may_be_made():
    shift = torch.zeros(1, *SHAPE, dtype=F64)
    a = Diffusion(KAPPA, shift, "flux")
    assert a.boundary_rhs(fluxes=1.0).any() and a.dense().isfinite().all()
    shift.fill_(1.0)
    assert prdp.linear_solve(a, right_hand_side(), prdp.CG(99))[1].solved.all()


@pytest.mark.parametrize("solver", SOLVERS, ids=repr)
def test_a_sample_that_nothing_holds_fails_alone(solver):
    shift = torch.tensor([2.0, 0.0, 0.5], dtype=F64).view(3, 1, 1).requires_grad_()
    b = right_hand_side().requires_grad_()
    with pytest.raises(ValueError, match="in sample 1 neither the shift nor a side holds u"):
        prdp.linear_solve(Diffusion(KAPPA, shift, "flux"), b, solver)
    u, info = prdp.linear_solve(Diffusion(KAPPA, shift, "flux"), b, solver, on_failure="return")
    assert info.status[1] == -9 and u[1].abs().max() == 0 and info.solved[[0, 2]].all()
    lone = prdp.linear_solve(Diffusion(KAPPA[1:2], shift[1:2], "flux"), b[1:2], solver, on_failure="zero_grad")[1]
    assert lone.status.tolist() == [-9]
    found = torch.autograd.grad(u.square().sum(), (b, shift))
    others = [0, 2]
    alone = Diffusion(KAPPA[others], shift[others], "flux")
    u, info = prdp.linear_solve(alone, b[others], solver)
    b_bar, shift_bar = torch.autograd.grad(u.square().sum(), (b, shift))
    torch.testing.assert_close(found, (b_bar, shift_bar))
    assert found[0][1].abs().max() == 0 and found[1][1] == 0


def test_on_a_device_and_in_tensor_operations_it_fails_alone():
    shift = torch.tensor([2.0, 0.0, 0.5], dtype=F64).view(3, 1, 1)
    a, b = Diffusion(KAPPA, shift, "flux"), right_hand_side()
    with Fibers(threads=32):
        u, info = prdp.linear_solve(a, b, prdp.CG(99), on_failure="return")
    assert info.way == "kernel" and info.status.tolist() == [1, -9, 1] and not u[1].any()
    own = prdp.CG(99, preconditioner=prdp.operators.Function(lambda v: v, symmetric=True))
    u, info = prdp.linear_solve(a, b, own, on_failure="return")
    assert info.way == "tensors" and info.status.tolist() == [1, -9, 1] and not u[1].any()


def test_what_one_number_holds_is_solved():
    shift = ZEROS.clone()
    shift[:, 2, 3] = 1e-3
    h = torch.zeros(3, SHAPE[0], dtype=F64)
    h[:, 1] = 1e-3
    for a in (Diffusion(KAPPA, shift, "flux"), Diffusion(KAPPA, 0.0, robin(h)), Diffusion(KAPPA, ZEROS, "zero")):
        b = right_hand_side()
        u, info = prdp.linear_solve(a, b, prdp.Direct())
        dense = torch.linalg.solve(a.dense(), b.flatten(1).unsqueeze(-1)).reshape_as(b)
        assert info.solved.all()
        torch.testing.assert_close(u, dense, rtol=1e-6, atol=1e-6 * float(dense.abs().max()))
