"""Solves in tensor operations on another device: what they report, how they fail, and how often the host looks."""

import itertools

import pytest
import torch
from stand_in_device import StandIn
from test_other_devices import F32, F64, OFFSETS, SHAPE, five_points, noise, product

import prdp_torch as prdp
from prdp_torch import _C, operators


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
    """A solve and its backward pass on the stand-in, and how often the host waited for the solve."""

    def __init__(self, make, g, b, solver, **options):
        self.device = device = StandIn()
        with device:
            leaves = [device.send(t).requires_grad_() for t in (g, b)]
            u, self.info = prdp.linear_solve(make(leaves[0]), leaves[1], solver, **options)
            self.looks = device.copies_to_host
            gradients = torch.autograd.grad(u.square().sum(), leaves)
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
    for found, expected in zip(run.gradients, torch.autograd.grad(u.square().sum(), leaves), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)
    with run.device:
        assert run.info.status.device.type != "cpu"
        reports = [(run.info, info), (run.info.adjoint, info.adjoint)]
    for there, here in reports:
        for found, expected in zip(there[:5], here[:5], strict=True):
            torch.testing.assert_close(run.device.fetch(found), expected, rtol=1e-2, atol=1e-14)


def one_of_each_end():
    """A regular sample, one of another sign, one with p·Ap = 0, and one with a NaN."""
    coefficients = torch.zeros(4, 1, 8, dtype=F64)
    signs = torch.tensor([1.0, -1.0] * 4, dtype=F64)
    coefficients[:, 0] = torch.stack([torch.ones(8), -torch.ones(8), signs, torch.full((8,), torch.nan)])
    return coefficients


@pytest.mark.parametrize("on_failure", SILENT)
@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_failed_sample_says_so_and_has_no_gradient(on_failure, dtype):
    b = torch.ones(4, 1, 8, dtype=dtype)
    run = Run(lambda c: operators.Stencil(c, [(0,)], "zero"), one_of_each_end().to(dtype), b, prdp.CG(3, 0.0),
              on_failure=on_failure)  # fmt: skip
    names = [prdp.SolveStatus(s).name for s in run.device.fetch(run.info.status).tolist()]
    assert names == ["CONVERGED", "CONVERGED", "BREAKDOWN", "NONFINITE_OPERATOR"]
    torch.testing.assert_close(run.u[:2], torch.stack([b[0], -b[0]]))
    assert run.u.isfinite().all() and (run.u[3] == 0).all()
    assert all(t.isfinite().all() for t in run.gradients) and (run.gradients[1][3] == 0).all()
    if on_failure == "zero_grad":
        assert (run.gradients[1][2] == 0).all()


@pytest.mark.parametrize("solver", [prdp.Jacobi(60, 0.0), prdp.CG(60, 0.0), prdp.SteepestDescent(60, 0.0)])
def test_iterations_that_run_away_hand_out_nothing_worse_than_zero(solver):
    """Jacobi diverges where the diagonal is small, CG and steepest descent where A is not definite."""
    c = torch.cat([five_points(4.3), five_points(-1.0)]).to(F32)
    c[1, 1:3] = 0.3
    run = Run(lambda c: operators.Stencil(c, OFFSETS, "periodic"), c, noise(2, 1, *SHAPE).to(F32), solver,
              on_failure="return")  # fmt: skip
    iterations, residual = [run.device.fetch(t) for t in run.info[:2]]
    assert residual[0] < 1 and residual[1] <= 1 and run.u.isfinite().all()
    if (run.u[1] == 0).all():
        assert iterations[1] == 0 and residual[1] == 1


def test_a_constant_outside_the_range_is_found_there():
    """As on the host: A without a named null space is tested for a constant that it maps to zero."""
    b = noise(2, 1, *SHAPE) + 2.0
    b[1] -= b[1].mean()
    run = Run(lambda c: operators.Stencil(c, OFFSETS, "periodic"), five_points(4.0), b, prdp.Jacobi(40, 0.0),
              on_failure="return")  # fmt: skip
    _, info = prdp.linear_solve(operators.Stencil(five_points(4.0), OFFSETS, "periodic"), b, prdp.Jacobi(40, 0.0),
                                on_failure="return")  # fmt: skip
    names = [prdp.SolveStatus(s).name for s in run.device.fetch(run.info.status).tolist()]
    assert names[0] == "INCONSISTENT" == prdp.SolveStatus(int(info.status[0])).name
    assert names[1] != "INCONSISTENT"


@pytest.mark.parametrize("solver", [prdp.Multigrid, lambda k, rtol: prdp.CG(k, rtol, preconditioner="multigrid")])
def test_cycles_run_on_the_host_whose_grids_are_kept(solver):
    """The adjoint solve finds those of the solve. A cycle is one copy to the host, and one back."""
    _C.clear_factorisations()
    make, c = OPERATORS["stencil"]
    b = noise(4, 1, *SHAPE)
    looks = []
    for k, scale, new in ((2, 1.0, 1), (5, 1.0, 0), (5, 1.5, 1)):
        before = _C.count_factorisations()
        run = Run(make, scale * c, b, solver(k, 0.0), on_failure="return")
        assert _C.count_factorisations() == before + new
        looks.append(run.looks)
        u, info = prdp.linear_solve(make(scale * c), b, solver(k, 0.0), on_failure="return")
        torch.testing.assert_close(run.u, u, rtol=1e-9, atol=1e-11)
        assert torch.equal(run.device.fetch(run.info.status), info.status)
    assert looks[1] == looks[2] == looks[0] + 3  # three more cycles


@pytest.mark.parametrize("name", ["burgers", "navier_stokes"])
def test_cycles_know_the_winds_of_the_device(name):
    winds, b = 0.3 * noise(2, 2, 8, 10), noise(2, 2 if name == "burgers" else 3, 8, 10)
    solver = prdp.BiCGStab(60, 1e-11, preconditioner="multigrid")
    if name == "navier_stokes":
        solver = prdp.GMRES(max_iter=20, rtol=1e-11, restart=20, preconditioner="multigrid")
        winds = torch.cat([winds, winds[:, :1]], 1)
        b[:, 2] -= b[:, 2].mean((-2, -1), keepdim=True)

    def make(u):
        return (operators.Burgers if name == "burgers" else operators.NavierStokes)(u, 0.05, 0.1)

    run = Run(make, winds, b, solver, on_failure="return")
    assert (run.device.fetch(run.info.status) > 0).all()
    leaves = [winds.clone().requires_grad_(), b.clone().requires_grad_()]
    u, _ = prdp.linear_solve(make(leaves[0]), leaves[1], prdp.Direct())
    torch.testing.assert_close(run.u, u, rtol=1e-7, atol=1e-9)
    for found, expected in zip(run.gradients, torch.autograd.grad(u.square().sum(), leaves), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("shape", [(6, 5, 9), (8, 7, 6), (11, 10), (5, 12), (13,), (10,)])
def test_cycles_are_those_of_the_loops(shape):
    """Every neighbour, each with a coefficient of its own; even and odd rings."""
    offsets = list(itertools.product((0, -1, 1), repeat=len(shape)))
    generator = torch.Generator().manual_seed(sum(shape))
    c = -1 - 0.5 * torch.rand(2, len(offsets), *shape, generator=generator, dtype=F64)
    c[:, 0] = 1.3 * c[:, 1:].abs().sum(1)
    b = noise(2, 1, *shape)
    run = Run(lambda c: operators.Stencil(c, offsets, "periodic"), c, b, prdp.Multigrid(2, 0.0), on_failure="return")
    a = operators.Stencil(c, offsets, "periodic")
    u, info = prdp.linear_solve(a, b, prdp.Multigrid(2, 0.0), on_failure="return")
    assert (info.residual < 0.5).all()
    torch.testing.assert_close(run.u, u, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_grids_are_made_again_where_a_single_coefficient_has_changed(dtype):
    """In place, without a word to autograd, and by little more than rounding."""
    _C.clear_factorisations()
    c = five_points(4.3).to(dtype).expand(1, 5, *SHAPE).contiguous()
    b = noise(2, 1, *SHAPE).to(dtype)
    device = StandIn()
    with device:
        there, rhs = device.send(c), device.send(b)
        for factor in (1.0, 1 + 100 * torch.finfo(dtype).eps, 3.0):
            there.numbers[0, 0, 2, 3] *= factor
            before = _C.count_factorisations()
            u, _ = prdp.linear_solve(operators.Stencil(there, OFFSETS, "periodic"), rhs, prdp.Multigrid(3, 0.0),
                                     on_failure="return")  # fmt: skip
            assert _C.count_factorisations() == before + 1
    expected = prdp.linear_solve(operators.Stencil(there.numbers, OFFSETS, "periodic"), b, prdp.Multigrid(3, 0.0),
                                 on_failure="return")[0]  # fmt: skip
    torch.testing.assert_close(device.fetch(u), expected, rtol=1e-4, atol=1e-5 if dtype == F32 else 1e-11)


def test_operations_of_an_iteration_with_a_cycle():
    coefficients = torch.tensor([4.3, -1, -1, -1, -1], dtype=F64).view(1, 5, 1, 1).expand(1, 5, 64, 64).contiguous()

    def launched(k):
        with StandIn() as device:
            a = operators.Stencil(device.send(coefficients), OFFSETS, "periodic")
            prdp.linear_solve(a, device.send(noise(1, 1, 64, 64)), prdp.Multigrid(k, 0.0), on_failure="return")
            return device.launched()

    assert launched(2) - launched(1) <= 40
