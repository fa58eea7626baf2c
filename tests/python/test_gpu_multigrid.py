"""Multigrid in the kernels of a GPU, run as fibers on the CPU, beside the CPU's own loops."""

import collections
import functools
import re
import time

import pytest
import torch
from fibers import BACKWARD, FORWARD, SHUFFLED, Fibers, barriers
from test_gpu_kernels import F32, F64, OFFSETS, agree, noise, solve

import prdp_torch as prdp
from prdp_torch import operators

TEAMS = {"cells": 48}  # a few blocks for a sample


def jumps(*shape, dtype, samples=3):
    """κ of boxes, a thousand times larger within."""
    kappa = torch.ones(samples, *shape, dtype=dtype)
    for s in range(samples):
        kappa[(s, *(slice(n // 4 + s, n // 2 + s) for n in shape))] = 1e3
    return kappa


def winds(dtype, samples=3):
    """Upwind differences of winds that change their direction, on a line and round a ring; not symmetric."""
    x = torch.linspace(0.0, 6.0, 11, dtype=dtype)
    w = torch.stack([3.0 * torch.sin(x + s) for s in range(samples)])[:, None, :].expand(samples, 9, 11)
    c = torch.zeros(samples, 5, 9, 11, dtype=dtype)
    c[:, 1], c[:, 2] = -1.0 - w.clamp(min=0.0), -1.0 + w.clamp(max=0.0)
    c[:, 3], c[:, 4] = -1.5, -0.5
    c[:, 0] = 0.2 - c[:, 1:].sum(1)
    return c


def ring(dtype):
    """-L round both axes, of an odd number of points and of an even one."""
    return torch.tensor([4.0, -1.0, -1.0, -1.0, -1.0], dtype=dtype).view(1, 5, 1, 1).expand(1, 5, 9, 10).contiguous()


OPERATORS = {  # with the shape of a sample
    "heat": (lambda t: operators.Heat((13, 10), torch.tensor(0.5, dtype=t), 1.0), (1, 13, 10)),
    "line": (lambda t: operators.Poisson((37,)), (1, 37)),
    "poisson 3D": (lambda t: operators.Poisson((5, 6, 7)), (1, 5, 6, 7)),
    "jumps": (lambda t: operators.Diffusion(jumps(12, 9, dtype=t), shift=0.1), (1, 12, 9)),
    "jumps 3D": (
        lambda t: operators.Diffusion(jumps(4, 5, 7, dtype=t), shift=0.1, boundary=("flux", "periodic", "zero")),
        (1, 4, 5, 7),
    ),
    "per axis": (
        lambda t: operators.Diffusion(jumps(2, 12, 9, dtype=t), 0.1, boundary=("flux", "zero"), per_axis=True),
        (1, 12, 9),
    ),
    "thin": (lambda t: operators.Diffusion(torch.ones(1, 3, 14, dtype=t), length=(0.01, 1.0), shift=1.0), (2, 3, 14)),
    "flat": (
        lambda t: operators.Diffusion(torch.ones(1, 3, 14, dtype=t), length=(0.01, 1.0), shift=1.0, boundary="flux"),
        (2, 3, 14),
    ),
    "winds": (lambda t: operators.Stencil(winds(t), OFFSETS, ("periodic", "zero")), (2, 9, 11)),
    "burgers": (lambda t: operators.Burgers(noise(3, 2, 9, 10, dtype=t), 0.05, 0.5), (2, 9, 10)),
    "burgers 1D": (lambda t: operators.Burgers(noise(1, 1, 21, dtype=t), 0.05, 0.5), (1, 21)),
    "navier-stokes": (lambda t: operators.NavierStokes(noise(3, 3, 6, 7, dtype=t), 0.05, 0.02), (3, 6, 7)),
    "ring": (lambda t: operators.Stencil(ring(t), OFFSETS, "periodic", nullspace="constant"), (2, 9, 10)),
    "closed": (lambda t: operators.Diffusion(jumps(7, 11, dtype=t), boundary="flux"), (1, 7, 11)),
}  # fmt: skip
SINGULAR = ["ring", "closed", "navier-stokes"]  # a constant in each channel, or in one


def right_hand_sides(name, dtype, samples=3):
    b = noise(samples, *OPERATORS[name][1], seed=3)
    if name in SINGULAR:
        b -= b.mean(tuple(range(2, b.dim())), keepdim=True)
    return b.to(dtype)


def with_cycles(method, **settings):
    if method is prdp.Multigrid:
        return prdp.Multigrid(**settings)
    if method is prdp.GMRES:
        settings["restart"] = 6
    return method(preconditioner="multigrid", **settings)


CASES = [  # each operator, method and dtype
    ("heat", prdp.CG, F32),
    ("line", prdp.Multigrid, F64),
    ("poisson 3D", prdp.CG, F64),
    ("jumps", prdp.MINRES, F64),
    ("jumps 3D", prdp.Multigrid, F32),
    ("per axis", prdp.CG, F64),
    ("thin", prdp.CG, F32),
    ("flat", prdp.CG, F64),
    ("winds", prdp.GMRES, F64),
    ("burgers", prdp.BiCGStab, F32),
    ("burgers 1D", prdp.GMRES, F64),
    ("ring", prdp.CG, F32),
    ("closed", prdp.GMRES, F64),
    ("navier-stokes", prdp.GMRES, F64),
]


@pytest.mark.parametrize(("name", "method", "dtype"), CASES)
def test_cycles_are_those_of_the_cpu(name, method, dtype):
    a, b = OPERATORS[name][0](dtype), right_hand_sides(name, dtype)
    rtol = 1e-4 if dtype == F32 else 1e-10
    solver = with_cycles(method, max_iter=60, rtol=rtol)
    mine, other = (solve(a, b, solver, device) for device in ({}, None))
    agree(mine, other, dtype, slack=10 * rtol / torch.finfo(dtype).eps)
    few = with_cycles(method, max_iter=2, rtol=0.0)
    mine, other = (solve(a, b, few, device) for device in ({}, None))
    agree(mine, other, dtype, slack=1e4)
    assert mine[1].way == "kernel"


def one(name, a, sample):
    """The operator of one sample alone."""
    if name == "navier-stokes":
        return operators.NavierStokes(noise(3, 3, 6, 7, dtype=F32)[sample : sample + 1], 0.05, 0.02)
    return operators.Stencil(winds(F32)[sample : sample + 1], OFFSETS, ("periodic", "zero"))


@pytest.mark.parametrize("name", ["winds", "navier-stokes"])
@pytest.mark.parametrize("device", [TEAMS, {"block_memory": 4 * 1100}], ids=["team", "partly in the block"])
def test_bits_depend_neither_on_the_order_of_threads_nor_on_neighbours(name, device):
    a, b = OPERATORS[name][0](F32), right_hand_sides(name, F32)
    solver = with_cycles(prdp.GMRES, max_iter=1, rtol=0.0)
    wanted, report = solve(a, b, solver, device)
    agree((wanted, report), solve(a, b, solver), F32, slack=1e3)
    for order in (BACKWARD, SHUFFLED):
        u, info = solve(a, b, solver, {**device, "order": order})
        assert torch.equal(u, wanted) and torch.equal(info.residual, report.residual)
    assert torch.equal(solve(one(name, a, 1), b[1:2], solver, device)[0][0], wanted[1])


def test_the_transpose_is_the_transpose():
    """Cycles are linear: ⟨w, B b⟩ = ⟨Bᵀ w, b⟩, where the gradient takes as many cycles of Aᵀ."""
    a, b = OPERATORS["winds"][0](F64), right_hand_sides("winds", F64).requires_grad_()
    w = noise(*b.shape, seed=5)
    with Fibers():
        u, _ = prdp.linear_solve(a, b, prdp.Multigrid(max_iter=2, rtol=0.0), backward="unrolled", on_failure="return")
        (gradient,) = torch.autograd.grad((w * u).sum(), b)
    torch.testing.assert_close((gradient * b).sum(), (w * u).sum(), rtol=1e-12, atol=0.0)


def test_gradients_are_those_of_the_cpu():
    kappa, b = jumps(12, 9, dtype=F64).requires_grad_(), right_hand_sides("jumps", F64).requires_grad_()

    def gradients():
        u, info = prdp.linear_solve(
            operators.Diffusion(kappa, shift=0.1), b, with_cycles(prdp.CG, max_iter=40, rtol=1e-12)
        )
        return *torch.autograd.grad(u.square().sum(), (kappa, b)), info

    *expected, told = gradients()
    with Fibers():
        *found, info = gradients()
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)
    assert info.adjoint.iterations.tolist() == told.adjoint.iterations.tolist()


@pytest.mark.parametrize(("name", "method"), [("winds", prdp.GMRES), ("jumps", prdp.CG)])
def test_second_derivatives_of_unrolled_solves_are_those_of_the_cpu(name, method):
    """Iterations that autograd records take their cycles, and those of the transpose, in launches."""
    a = OPERATORS[name][0](F64)

    def derivatives():
        b = right_hand_sides(name, F64).requires_grad_()
        solver = with_cycles(method, max_iter=2, rtol=0.0)
        u, _ = prdp.linear_solve(a, b, solver, backward="unrolled", on_failure="return")
        (first,) = torch.autograd.grad((u**3).sum(), b, create_graph=True)
        return u.detach(), first.detach(), *torch.autograd.grad(first.square().sum(), b)

    expected, device = derivatives(), Fibers()
    with device:
        before = device.launches()
        found = derivatives()
    assert device.launches() > before + 4
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-14)


def test_what_has_no_coarse_grids_fails_alone():
    c, b = winds(F64, samples=5), noise(5, 1, 9, 11, seed=3)
    c[1, 0, 2, 3], c[2, 1, 0, 0], b[3, 0, 1, 1], b[4] = 0.0, torch.inf, torch.nan, 0.0
    a, solver = operators.Stencil(c, OFFSETS, ("periodic", "zero")), with_cycles(prdp.GMRES, max_iter=9, rtol=1e-8)
    (u, info), (v, report) = (solve(a, b, solver, device) for device in ({}, None))
    assert info.status.tolist() == report.status.tolist()
    assert info.operator_applications[1:].tolist() == report.operator_applications[1:].tolist()
    names = [prdp.SolveStatus(s).name for s in info.status.tolist()]
    assert names == ["CONVERGED", "ZERO_DIAGONAL", "NONFINITE_OPERATOR", "NONFINITE_INPUT", "CONVERGED"]
    torch.testing.assert_close(u, v, rtol=1e-6, atol=1e-8)


def outcomes(left_out):
    """One after the other."""
    cases = [
        ("ring", prdp.GMRES, {}, FORWARD),
        ("jumps", prdp.GMRES, {}, BACKWARD),
        ("navier-stokes", prdp.BiCGStab, TEAMS, FORWARD),
        ("navier-stokes", prdp.BiCGStab, TEAMS, BACKWARD),
    ]
    for name, method, device, order in cases:
        a, b = OPERATORS[name][0](F32), right_hand_sides(name, F32)
        cycles = with_cycles(method, max_iter=1, rtol=0.0)
        try:
            u, info = solve(a, b, cycles, {**device, "order": order, "left_out": left_out})
        except RuntimeError:
            yield "irregular"
            continue
        yield u.nan_to_num(7.0).flatten().tolist(), info.residual.nan_to_num(7.0).tolist()


def test_every_barrier_is_needed():
    wanted = list(outcomes(left_out=0))
    unnoticed = [
        line
        for line in barriers("multigrid")
        if all(mine == other for mine, other in zip(outcomes(line), wanted, strict=True))
    ]
    assert not unnoticed


WITH_SHARED_GRIDS = {  # one A for all samples
    "heat": (lambda: OPERATORS["heat"][0](F32), (24, 1, 13, 10), prdp.CG),
    "wind": (lambda: operators.Stencil(winds(F32, 1), OFFSETS, ("periodic", "zero")), (24, 2, 9, 11), prdp.GMRES),
}


@pytest.mark.parametrize("name", WITH_SHARED_GRIDS)
def test_coarse_grids_are_kept_for_the_adjoint_solve(name):
    """Where they are small beside b; that of a sample alone makes its own, and both gradients have the same bits. A
    launch for the grids, one for each solve, and new memory: the host looks at nothing."""
    make, shape, method = WITH_SHARED_GRIDS[name]
    a, b, w = make(), noise(*shape, seed=3, dtype=F32), noise(*shape, seed=5, dtype=F32)

    def solve_and_differentiate(b, w):
        u, _ = prdp.linear_solve(a, b, with_cycles(method, max_iter=4, rtol=1e-4), on_failure="return")
        return torch.autograd.grad(u, b, w)[0]

    found = []
    with Fibers(poison=False) as fibers:
        for samples, launches, memory in ((slice(None), 3, 5 + 3), (slice(7, 8), 4, 5 + 5)):
            given = b[samples].clone().requires_grad_(), w[samples]
            solve_and_differentiate(*given)  # the first results of a kernel are compared
            before = fibers.launches()
            with torch.autograd.profiler.profile() as profiler:
                found.append(solve_and_differentiate(*given))
            assert fibers.launches() - before == launches
            seen = collections.Counter(e.name for e in profiler.function_events if e.name.startswith("aten::"))
            assert seen == {"aten::empty": memory}
    assert found[0][7].any() and torch.equal(found[0][7], found[1][0])


def test_a_rollout_with_the_same_operator_makes_its_coarse_grids_once():
    step = prdp.Heat((13, 10), nu=0.5, dt=1.0, solver=prdp.CG(4, preconditioner="multigrid"), on_failure="return")
    u = noise(24, 1, 13, 10, dtype=F32).requires_grad_()

    def launches(run):
        before = fibers.launches()
        found = run()
        return found, fibers.launches() - before

    with Fibers() as fibers:
        step.rollout(u, 3).sum().backward()
        states, forward = launches(lambda: step.rollout(u, 3))
        _, back = launches(lambda: states.sum().backward())
        chain = step(step(step(u.detach())))
    assert (forward, back) == (4, 3)
    assert torch.equal(states[:, 3], chain)


LONGEST = functools.partial(prdp.GMRES, restart=50)


def seconds_to_compile(kernel):
    """And the compiled text, for a grid of many points: longer loops are not longer texts."""
    many_points = re.sub(r"Grid<1, \d+, \d+>", "Grid<1, 64, 64>", kernel.text)
    started = time.process_time()
    size, error = kernel._replace(text=many_points).compile(90)
    assert not error
    return time.process_time() - started, size


@pytest.mark.alone
@pytest.mark.parametrize(
    ("name", "method", "dtype", "most"),
    [
        ("jumps", prdp.CG, F32, 300_000),
        ("navier-stokes", prdp.GMRES, F32, 300_000),
        ("navier-stokes", LONGEST, F64, 350_000),
    ],
)
def test_they_compile_for_a_card(name, method, dtype, most, tmp_path, monkeypatch):
    """In not much more time than the method alone: loops that the compiler unrolls would take a minute."""
    monkeypatch.setenv("PRDP_CACHE", str(tmp_path))
    a, b = OPERATORS[name][0](dtype), right_hand_sides(name, dtype)
    solve(a, b, method(1), {})
    seconds_to_compile(Fibers().kernels()[-1])  # loads the compiler
    monkeypatch.setenv("PRDP_CACHE", str(tmp_path / "empty"))
    of_method, _ = seconds_to_compile(Fibers().kernels()[-1])
    solve(a, b, with_cycles(method, max_iter=1), {})
    coarse_grids, cycles = Fibers().kernels()
    assert "make_hierarchies" in coarse_grids.text
    for kernel in (coarse_grids, cycles):
        seconds, size = seconds_to_compile(kernel)
        assert seconds < 3 * of_method and 10_000 < size < most
