"""Solves in tensor operations on another device: what they report, how they fail, and how often the host looks."""

import pytest
import torch
from stand_in_device import StandIn
from test_other_devices import F32, F64, OFFSETS, SHAPE, five_points, noise, product

import prdp_torch as prdp
from prdp_torch import operators


def weighted(v, weight):
    return product(v) + weight * v


OPERATORS = {  # made of one tensor, which gets a gradient
    "stencil": (lambda c: operators.Stencil(c, OFFSETS, "periodic"), five_points(4.3)),
    "function": (
        lambda w: operators.Function(weighted, tensors=[w], symmetric=True, diagonal=lambda w: 4.3 + w),
        torch.rand(*SHAPE, dtype=F64, generator=torch.Generator().manual_seed(3)),
    ),
}
SOLVERS = {
    "jacobi": prdp.Jacobi(40, 0.0),
    "steepest_descent": prdp.SteepestDescent(40, 0.0),
    "cg": prdp.CG(40, 0.0),
    "cg, diagonal": prdp.CG(40, 0.0, preconditioner="diagonal"),
}
SILENT = ["return", "zero_grad"]


class Run:
    """A solve and its backward pass on the stand-in, and how often the host waited in each."""

    def __init__(self, make, g, b, solver, **options):
        self.device = device = StandIn()
        with device:
            leaves = [device.send(t).requires_grad_() for t in (g, b)]
            u, self.info = prdp.linear_solve(make(leaves[0]), leaves[1], solver, **options)
            self.forward = device.copies_to_host
            gradients = torch.autograd.grad(u.square().sum(), leaves)
            self.backward = device.copies_to_host - self.forward
            self.from_host = device.copies_from_host
        self.u, self.gradients = device.fetch(u), [device.fetch(t) for t in gradients]


@pytest.mark.parametrize("on_failure", SILENT)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", OPERATORS)
def test_solutions_gradients_and_reports_are_those_of_the_cpu(name, solver, on_failure):
    make, g = OPERATORS[name]
    b = noise(4, 1, *SHAPE)
    run = Run(make, g, b, SOLVERS[solver], on_failure=on_failure)
    leaves = [g.clone().requires_grad_(), b.clone().requires_grad_()]
    u, info = prdp.linear_solve(make(leaves[0]), leaves[1], SOLVERS[solver])
    torch.testing.assert_close(run.u, u, rtol=1e-10, atol=1e-12)
    for mine, other in zip(run.gradients, torch.autograd.grad(u.square().sum(), leaves), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-10)
    with run.device:
        assert run.info.status.device.type != "cpu"
        reports = [(run.info, info), (run.info.adjoint, info.adjoint)]
    for there, here in reports:
        for mine, other in zip(there[:5], here[:5], strict=True):
            torch.testing.assert_close(run.device.fetch(mine), other, rtol=1e-2, atol=1e-14)


def ill_assorted():
    """A regular sample, one of another sign, one with p·Ap = 0, and one with a NaN."""
    coefficients = torch.zeros(4, 1, 8, dtype=F64)
    signs = torch.tensor([1.0, -1.0] * 4, dtype=F64)
    coefficients[:, 0] = torch.stack([torch.ones(8), -torch.ones(8), signs, torch.full((8,), torch.nan)])
    return coefficients


@pytest.mark.parametrize("on_failure", SILENT)
@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_failed_sample_says_so_and_has_no_gradient(on_failure, dtype):
    b = torch.ones(4, 1, 8, dtype=dtype)
    run = Run(lambda c: operators.Stencil(c, [(0,)], "zero"), ill_assorted().to(dtype), b, prdp.CG(3, 0.0),
              on_failure=on_failure)  # fmt: skip
    names = [prdp.SolveStatus(s).name for s in run.device.fetch(run.info.status).tolist()]
    assert names == ["CONVERGED", "CONVERGED", "BREAKDOWN", "NONFINITE_OPERATOR"]
    torch.testing.assert_close(run.u[:2], torch.stack([b[0], -b[0]]))
    assert run.u.isfinite().all() and (run.u[3] == 0).all()
    assert all(t.isfinite().all() for t in run.gradients) and (run.gradients[1][3] == 0).all()
    if on_failure == "zero_grad":
        assert (run.gradients[1][2] == 0).all()


@pytest.mark.parametrize("solver", [prdp.Jacobi(60, 0.0), prdp.CG(60, 0.0), prdp.SteepestDescent(60, 0.0)])
def test_iterations_that_run_away_leave_zero_and_say_so(solver):
    """Jacobi diverges where the diagonal is small, CG and steepest descent where A is not definite."""
    c = torch.cat([five_points(4.3), five_points(-1.0)]).to(F32)
    c[1, 1:3] = 0.3
    run = Run(lambda c: operators.Stencil(c, OFFSETS, "periodic"), c, noise(2, 1, *SHAPE).to(F32), solver,
              on_failure="return")  # fmt: skip
    info = [run.device.fetch(t) for t in run.info[:5]]
    residual = info[1]
    assert residual[0] < 1 and residual[1] <= 1 and run.u.isfinite().all()
    if (run.u[1] == 0).all():
        assert info[0][1] == 0 and residual[1] == 1


def test_a_constant_that_a_cannot_reach_is_found_there():
    """As on the host: after so many products, A without a named null space is looked at."""
    b = noise(2, 1, *SHAPE) + 2.0
    b[1] -= b[1].mean()
    run = Run(lambda c: operators.Stencil(c, OFFSETS, "periodic"), five_points(4.0), b, prdp.Jacobi(40, 0.0),
              on_failure="return")  # fmt: skip
    _, info = prdp.linear_solve(operators.Stencil(five_points(4.0), OFFSETS, "periodic"), b, prdp.Jacobi(40, 0.0),
                                on_failure="return")  # fmt: skip
    names = [prdp.SolveStatus(s).name for s in run.device.fetch(run.info.status).tolist()]
    assert names[0] == "INCONSISTENT" == prdp.SolveStatus(int(info.status[0])).name
    assert names[1] != "INCONSISTENT"


@pytest.mark.parametrize("solver", [prdp.Multigrid(2), prdp.CG(2, preconditioner="multigrid")])
def test_multigrid_is_refused_where_it_has_no_kernel(solver):
    with pytest.raises(NotImplementedError, match="multigrid runs on the CPU and in the kernels of a GPU, got vectors"):
        make, c = OPERATORS["stencil"]
        Run(make, c, noise(4, 1, *SHAPE), solver)
