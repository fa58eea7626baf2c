"""Multigrid as a preconditioner and as a method: dense truth, both derivatives, threads, failures."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import field, statuses, written

import prdp_torch as prdp
from prdp_torch import _C, operators

F64 = torch.float64
MULTIGRID = {"preconditioner": "multigrid"}
METHODS = {
    "cg": lambda k, rtol: prdp.CG(k, rtol=rtol, **MULTIGRID),
    "gmres": lambda k, rtol: prdp.GMRES(k, rtol=rtol, restart=20, **MULTIGRID),
    "bicgstab": lambda k, rtol: prdp.BiCGStab(k, rtol=rtol, **MULTIGRID),
    "cycles": lambda k, rtol: prdp.Multigrid(k, rtol=rtol),
}


def diffusion(kappa, shift=0.0, boundary="zero", winds=None, weights=None, **options):
    """-∇·(κ ∇u) + shift u (+ upwind winds·∇u) for κ on a unit box, as a `Stencil`."""
    dim, n = kappa.dim(), kappa.shape
    offsets, fields = [(0,) * dim], [torch.full_like(kappa, shift)]
    for axis in range(dim):
        h = 1 / n[axis] if boundary == "periodic" else 1 / (n[axis] + 1)
        for step in (-1, 1):
            there = kappa.roll(-step, axis)
            if boundary == "zero":
                there.select(axis, -1 if step > 0 else 0).copy_(kappa.select(axis, -1 if step > 0 else 0))
            face = 2 * kappa * there / (kappa + there) / h**2 * (weights[axis] if weights else 1.0)
            if winds is not None:
                face = face + (-step * winds[axis]).clamp_min(0) / h
            offsets.append(tuple(step if d == axis else 0 for d in range(dim)))
            fields.append(-face)
            fields[0] = fields[0] + face
    return operators.Stencil(torch.stack(fields)[None], offsets, boundary, **options)


def blobs(shape, contrast, seed=1):
    g = np.random.default_rng(seed)
    y = np.meshgrid(*[np.arange(n) / n for n in shape], indexing="ij")
    s = np.zeros(shape)
    for _ in range(12):
        k = g.integers(-6, 7, len(shape))
        phase = 2 * np.pi * sum(a * b for a, b in zip(k, y, strict=True)) + 6 * g.random()
        s = s + g.standard_normal() * np.sin(phase)
    s = (s - s.min()) / (s.max() - s.min())
    return torch.tensor(contrast**s)


def noise(shape, seed=0, dtype=F64):
    return torch.randn(1, 1, *shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def windy(shape, peclet, shift=100.0):
    y, x = np.meshgrid(*[np.arange(n) / n for n in shape], indexing="ij")
    speed = peclet * shape[0]
    winds = [torch.tensor(speed * np.cos(2 * np.pi * x)), torch.tensor(speed * np.sin(2 * np.pi * y))]
    return diffusion(torch.ones(shape).double(), shift, "periodic", winds=winds)


def turning_winds(shape, peclet):
    winds = field(shape, channels=2, batch=1)[0] * peclet * shape[0]
    return diffusion(torch.ones(shape).double(), 100.0, "periodic", winds=list(winds))


def negative(a):
    return operators.Stencil(-a.tensors[0], a.offsets, "periodic")


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["heat", "stencil", "winds", "burgers"])
def test_solutions_and_gradients_equal_those_of_lapack(kind, method, transposed):
    if method == "cg" and kind in ("winds", "burgers"):
        return
    shape, channels = (9, 7), 2 if kind == "burgers" else 1
    a = {
        "heat": lambda: operators.Heat(shape, torch.tensor(0.3, dtype=F64), 1.0),
        "stencil": lambda: diffusion(blobs(shape, 1e3), 1.0),
        "winds": lambda: windy(shape, 2.0),
        "burgers": lambda: operators.Burgers(field(shape, channels=2, batch=2), torch.tensor(0.01, dtype=F64), 0.1),
    }[kind]()
    tensors = [t.requires_grad_() for t in a.tensors]
    b = field(shape, channels=channels, batch=2).requires_grad_()
    found, exact = [], []
    for results, solver in ((found, METHODS[method](90, 1e-13)), (exact, prdp.Direct())):
        u, info = prdp.linear_solve(a, b, solver)
        assert info.solved.all()
        results += [u, *torch.autograd.grad(u.square().sum() + u[..., 0].sum(), [b, *tensors])]
    for ours, theirs in zip(found, exact, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-8 * theirs.abs().max().item())


@pytest.mark.parametrize("method", METHODS)
def test_unrolled_gradients_of_b(method):
    a = windy((6, 5), 2.0) if method != "cg" else diffusion(blobs((6, 5), 10.0))
    solver = METHODS[method](2, 0.0)
    solve = lambda b: prdp.linear_solve(a, b, solver, "unrolled", on_failure="return")[0]  # noqa: E731
    assert torch.autograd.gradcheck(solve, noise((6, 5)).requires_grad_())


def test_truncated_cycles_are_a_linear_map_whose_transpose_is_as_many_cycles():
    a = windy((33, 40), 5.0)
    b, cotangent = noise((33, 40)).requires_grad_(), noise((33, 40), seed=1)
    for backward in ("implicit", "unrolled"):
        u, _ = prdp.linear_solve(a, b, prdp.Multigrid(2, rtol=0.0), backward)
        (b_bar,) = torch.autograd.grad((u * cotangent).sum(), b)
        torch.testing.assert_close((b_bar * b).sum(), (cotangent * u).sum(), rtol=1e-11, atol=0.0)


WARNED = """
import sys, warnings, torch, prdp_torch as prdp
kappa, b = torch.ones(1, 8, 8, requires_grad=True), torch.ones(1, 1, 8, 8, requires_grad=True)
for backward, solver in [("implicit", prdp.Multigrid(1)), ("unrolled", prdp.CG(3)), ("unrolled", prdp.Multigrid(1)),
                         ("unrolled", prdp.CG(3, preconditioner="multigrid"))]:
    for inputs in (b, (b, kappa)):
        print(backward, solver.method, len(inputs), flush=True, file=sys.stderr)
        u, _ = prdp.linear_solve(prdp.operators.Diffusion(kappa, 1.0), b, solver, backward=backward)
        torch.autograd.grad(u.sum(), inputs)
"""


def test_cycles_that_count_as_constants_are_told_once():
    """Where a gradient of A is asked for, which they make zero after one cycle."""
    done = subprocess.run([sys.executable, "-c", WARNED], capture_output=True, text=True, check=True)
    before, *told = done.stderr.split("leaves out how the cycles of multigrid depend on A")
    assert len(told) == 1 and 'backward="implicit"' in told[0] and "unrolled multigrid 2" in before, done.stderr


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_every_bit_is_the_same_on_any_number_of_threads(dtype):
    a = diffusion(blobs((200, 210), 1e3).to(dtype))
    b = noise((200, 210), dtype=dtype).requires_grad_()
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            for solver in (
                prdp.CG(4, rtol=0.0, **MULTIGRID),
                prdp.CG(9, rtol=0.0),
                prdp.GMRES(4, rtol=0.0),
                prdp.Jacobi(9, 0.0),
            ):
                u, _ = prdp.linear_solve(a, b, solver, on_failure="return")
                results.append((threads, u.detach(), torch.autograd.grad(u.sum(), b)[0]))
    finally:
        torch.set_num_threads(before)
    for i, (_, u, g) in enumerate(results):
        assert torch.equal(u, results[i % 4][1]) and torch.equal(g, results[i % 4][2])


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e12, 1e30])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_the_scale_of_the_operator_changes_nothing(dtype, scale):
    factor = 2.0 ** round(np.log2(scale))
    plain = diffusion(blobs((40, 30), 10.0).to(dtype))
    scaled = operators.Stencil(plain.tensors[0] * factor, plain.offsets)
    b = noise((40, 30), dtype=dtype)
    for solver in (prdp.CG(4, rtol=1e-4, **MULTIGRID), prdp.Multigrid(9, rtol=1e-4)):
        u, info = prdp.linear_solve(plain, b, solver)
        v, again = prdp.linear_solve(scaled, b * factor, solver)
        assert torch.equal(u, v) and torch.equal(info.residual, again.residual)


def test_a_batch_solves_each_sample_as_alone_and_a_bad_one_fails_alone():
    kappa = torch.stack([blobs((20, 21), 100.0, seed) for seed in range(3)])
    a = operators.Diffusion(kappa)
    b = noise((20, 21)).expand(3, -1, -1, -1)
    solver = prdp.CG(9, rtol=1e-6, **MULTIGRID)
    u, _ = prdp.linear_solve(a, b, solver)
    for i in range(3):
        alone, _ = prdp.linear_solve(operators.Diffusion(kappa[i : i + 1]), b[i : i + 1], solver)
        assert torch.equal(u[i : i + 1], alone)
    bad = kappa.clone()
    bad[1, 3, 4] = torch.inf
    v, info = prdp.linear_solve(operators.Diffusion(bad), b, solver, on_failure="return")
    assert statuses(info) == ["CONVERGED", "NONFINITE_OPERATOR", "CONVERGED"]
    assert torch.equal(v[0], u[0]) and torch.equal(v[2], u[2]) and v[1].abs().max() == 0


def test_what_it_cannot_do_is_said():
    b = noise((8, 8))
    far = operators.Stencil(torch.ones(1, 2, 8, 8, dtype=F64), [(0, 0), (0, 2)])
    matrix = operators.Matrix(torch.eye(64, dtype=F64))
    for a, of_a in ((far, b), (matrix, b.reshape(1, 64))):
        for solver in (prdp.CG(3, **MULTIGRID), prdp.Multigrid(3)):
            with pytest.raises(ValueError, match=r"is for Heat, Poisson, Burgers, .* and Stencil with neighbours"):
                prdp.linear_solve(a, of_a, solver)
    hollow = diffusion(torch.ones(8, 8, dtype=F64))
    hollow.tensors[0][0, 0, 3, 3] = 0.0
    _, info = prdp.linear_solve(hollow, b, prdp.Multigrid(3), on_failure="return")
    assert statuses(info) == ["ZERO_DIAGONAL"]
    with pytest.raises(ValueError, match="smoothing"):
        prdp.Multigrid(3, smoothing=0)


@pytest.mark.parametrize("way", ["--auto", "--prdp"])
def test_the_cpp_trainer_refines_it(tmp_path, way):
    path = written(tmp_path, ('method = "jacobi"', 'method = "multigrid"'))
    trainer = Path(__file__).parents[2] / "build" / "prdp_train"
    command = [trainer, path, "--out", tmp_path / "out", way, "--intervals", "3"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (record,) = (tmp_path / "out").glob("*/seed_0.json")
    assert json.loads(record.read_text())["curves"]["failed"] == [0, 0, 0]


def test_steps_and_rollouts_take_it():
    step = prdp.Heat((40, 40), 1.0, 0.01, solver=prdp.Multigrid(20, rtol=1e-10))
    exact = prdp.Heat((40, 40), 1.0, 0.01, solver=prdp.Direct())
    u = field((40, 40), channels=1, batch=2).requires_grad_()
    results = [torch.autograd.grad(s.rollout(u, 3).square().sum(), u)[0] for s in (step, exact)]
    torch.testing.assert_close(*results, rtol=1e-7, atol=1e-9)
    assert step.info.solved.all()


def test_a_controller_sets_the_number_of_cycles():
    step = prdp.Heat((15, 15), 1e-2, 1.0, prdp.Multigrid(1, 0.0))
    u = field((15, 15), 2)
    for k in (1, 2, 5):
        step.max_iter = k
        step(u)
        assert step.info.iterations.tolist() == [k, k]
    with pytest.raises(ValueError, match="max_iter must be >= 0, got -1"):
        step.max_iter = -1


FLOW = field((6, 7), 2, channels=3)
SYSTEMS = {
    "heat": (operators.Heat((9, 10), 1.0, 0.02), (9, 10), 1),
    "diffusion": (operators.Diffusion(blobs((9, 10), 50.0, 1)[None]), (9, 10), 1),
    "burgers": (operators.Burgers(FLOW[:, :2], 1e-2, 0.1), (6, 7), 2),
    "negative winds": (negative(turning_winds((9, 10), 3.0)), (9, 10), 1),
    "navier_stokes": (operators.NavierStokes(FLOW, 1e-2, 0.1), (6, 7), 3),
}
SOLVERS_OF = {
    "heat": [prdp.CG(3, rtol=0.0, **MULTIGRID), prdp.Multigrid(3, rtol=0.0)],
    "diffusion": [prdp.CG(3, rtol=0.0, **MULTIGRID), prdp.GMRES(1, rtol=0.0, restart=3, **MULTIGRID)],
    "burgers": [prdp.BiCGStab(2, rtol=0.0, **MULTIGRID), prdp.Multigrid(2, rtol=0.0)],
    "negative winds": [prdp.BiCGStab(2, rtol=0.0, **MULTIGRID), prdp.Multigrid(2, rtol=0.0)],
    "navier_stokes": [prdp.GMRES(2, rtol=0.0, restart=3, **MULTIGRID)],
}
PAIRS = [(kind, solver) for kind, solvers in SOLVERS_OF.items() for solver in solvers]
PAIR_IDS = [f"{kind}-{type(solver).__name__}" for kind, solver in PAIRS]


@pytest.mark.parametrize("kind, solver", PAIRS, ids=PAIR_IDS)
def test_plain_tensors_take_the_same_iterations(kind, solver):
    a, shape, channels = SYSTEMS[kind]
    b = field(shape, 2, channels=channels, seed=4)
    u, _ = prdp.linear_solve(a, b, solver, on_failure="return")
    v, _ = _C.solve_with_tensors(
        b, a.tensors, a.kind, a.shape, a.parameters, False, solver.method, solver.max_iter, 0.0, solver.restart,
        preconditioner="multigrid",
    )  # fmt: skip
    torch.testing.assert_close(u, v, rtol=1e-8, atol=1e-10 * float(u.abs().max()))


# torch's own forward mode warns when it is first used.
@pytest.mark.filterwarnings("ignore:`torch.jit.script")
@pytest.mark.parametrize("kind, solver", PAIRS, ids=PAIR_IDS)
def test_recorded_derivatives_of_unrolled_iterations_know_the_cycles(kind, solver):
    """With create_graph=True and in forward mode, the iterations run in plain tensor operations."""
    a, shape, channels = SYSTEMS[kind]

    def solve(b):
        return prdp.linear_solve(a, b, solver, backward="unrolled", on_failure="return")[0]

    b = field(shape, 2, channels=channels, seed=4).requires_grad_()
    w = field(shape, 2, channels=channels, seed=5)
    u = solve(b)
    (plain,) = torch.autograd.grad((u * w).sum(), b)
    (recorded,) = torch.autograd.grad((solve(b) * w).sum(), b, create_graph=True)
    torch.testing.assert_close(recorded, plain, rtol=1e-7, atol=1e-9 * float(plain.abs().max()))
    step = 1e-6
    _, along = torch.func.jvp(solve, (b.detach(),), (w,))
    ahead, behind = (solve(b.detach() + s * w) for s in (step, -step))
    expected = (ahead - behind) / (2 * step)
    torch.testing.assert_close(along, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("backward", ["implicit", "unrolled"])
def test_cycles_end_at_the_rounding_of_float32(backward):
    """A tolerance that float32 cannot reach does not cost every cycle that is allowed."""
    A = diffusion(blobs((63, 63), 100.0).float())
    b = noise((63, 63), dtype=torch.float32).requires_grad_()
    u, info = prdp.linear_solve(A, b, prdp.Multigrid(max_iter=200, rtol=1e-12), backward=backward)
    assert statuses(info) == ["STAGNATED"] and info.solved.all() and info.floor.item() > 0
    assert info.iterations.item() <= 20
    (gradient,) = torch.autograd.grad(u.sum(), b)
    exact = torch.linalg.solve(A.dense().double(), torch.ones(63 * 63, dtype=F64)).view_as(b)
    assert (gradient - exact).norm() < 1e-3 * exact.norm()
    refined, of_float64 = prdp.linear_solve(
        diffusion(blobs((63, 63), 100.0)), b.detach().double(), prdp.Multigrid(max_iter=200, rtol=1e-12)
    )
    assert statuses(of_float64) == ["CONVERGED"] and (u.double() - refined).norm() < 1e-3 * refined.norm()
