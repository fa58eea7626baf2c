"""`Flow` by the kernels of a GPU, run as fibers on the CPU, beside the CPU's own loops."""

import contextlib
import os

import pytest
import torch
from fibers import BACKWARD, SHUFFLED, Fibers, barriers

import prdp_torch as prdp

F32, F64 = torch.float32, torch.float64
CELLS = 20  # of a block: two and more for a sample


def noise(*shape, seed=0, dtype=F64):
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def obstacle(shape):
    solid = torch.zeros(shape, dtype=torch.bool)
    solid[2, 2:4] = True
    return solid


PLANE, BOX = (5, 6), (3, 4, 5)
# A wall at an end of axis 0 moves along itself.
ALONG = {2: torch.tensor([1.0, 0.0]).view(2, 1), 3: torch.tensor([1.0, 1.0, 0.0]).view(3, 1, 1)}
CASES = {  # shape, settings, and tensors that get a gradient beside u and nu
    "periodic": (PLANE, {"nu": 0.02}, {}),
    "explicit, upwind": (
        PLANE,
        {"nu": 0.01, "diffusion": "explicit", "advection": "upwind"},
        {"force": noise(2, 2, *PLANE)},
    ),
    "cavity": (
        PLANE,
        {"nu": 0.05, "boundary": "wall", "advection": "upwind", "length": (1.0, 2.0)},
        {"lid": noise(1, 2, 6) * ALONG[2]},
    ),
    "viscous": (PLANE, {"nu": 5.0, "boundary": ("wall", "periodic")}, {"force": torch.tensor([1.0, -0.5])}),
    "channel": (
        PLANE,
        {"nu": 0.02, "boundary": ("wall", "open"), "obstacle": obstacle(PLANE)},
        {"inflow": noise(2, 2, 5, 1), "lid": torch.tensor([0.3, 0.0])},
    ),
    "box": (
        BOX,
        {"nu": 0.02, "boundary": ("wall", "open", "periodic"), "diffusion": "explicit"},
        {"inflow": torch.tensor([0.1, 1.0, 0.2]), "lid": noise(2, 3, 4, 5) * ALONG[3]},
    ),
    "slip": (PLANE, {"nu": 0.05, "boundary": ("slip", "open")}, {"inflow": noise(2, 2, 5, 1)}),
    "slip, upwind": (
        BOX,
        {"nu": 0.02, "boundary": ("slip", "periodic", "slip"), "advection": "upwind"},
        {"force": noise(2, 3, *BOX)},
    ),
    "implicit box": (BOX, {"nu": 0.02, "boundary": ("wall", "wall", "periodic")}, {"force": noise(1, 3, *BOX)}),
}


def flow(name, dtype=F64, nu=None, given=None, **options):
    shape, settings, tensors = CASES[name]
    given = {key: t.to(dtype) for key, t in tensors.items()} if given is None else dict(given)
    if "lid" in given:
        given["wall_velocity"] = {(0, "high"): given.pop("lid")}
    settings = {**settings, **given, **options, "nu": settings["nu"] if nu is None else nu}
    return prdp.Flow(shape, dt=0.01, solver=prdp.CG(200, rtol=1e-13 if dtype == F64 else 1e-6), **settings)


def with_leaves(name, dtype=F64, **options):
    """A step, and what gets a gradient: u, nu and the tensors of the case."""
    shape, settings, tensors = CASES[name]
    leaves = [0.5 * noise(2, len(shape), *shape, seed=1, dtype=dtype), torch.tensor(settings["nu"], dtype=dtype)]
    leaves = [t.requires_grad_() for t in (*leaves, *(t.to(dtype, copy=True) for t in tensors.values()))]
    return flow(name, dtype, leaves[1], dict(zip(tensors, leaves[2:], strict=True)), **options), leaves


def outcome(name, dtype=F64, steps=2, **options):
    """States and gradients of everything."""
    step, leaves = with_leaves(name, dtype, **options)
    states = step.rollout(leaves[0], steps)
    weights = noise(*states.shape, seed=2, dtype=dtype)
    return states.detach(), *torch.autograd.grad((weights * states).sum(), leaves), step.info, step.adjoint_info


@pytest.mark.parametrize("name", CASES)
def test_states_and_gradients_are_those_of_the_cpu(name):
    *expected, info, adjoint = outcome(name)
    with Fibers():
        *found, report, adjoint_report = outcome(name)
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-10)
    assert torch.equal(report.status, info.status) and torch.equal(adjoint_report.status, adjoint.status)
    assert report.way == "kernel"


def test_the_explicit_part_has_the_bits_of_the_loops():
    """No solve, and no multiply-add: the sums are the same."""
    step, u = flow("periodic", F32), noise(2, 2, *PLANE, dtype=F32)
    with torch.no_grad():
        expected = step.divergence(u)
        with Fibers():
            assert torch.equal(step.divergence(u), expected)


def test_float32_and_the_pressure():
    shape = CASES["channel"][0]
    u = noise(2, 2, *shape, seed=1, dtype=F32)
    expected = [t.detach() for t in flow("channel", F32).step_and_pressure(u)]
    with Fibers():
        found = flow("channel", F32).step_and_pressure(u)
        with torch.no_grad():
            projected = flow("channel", F32).project(u)
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(projected, flow("channel", F32).project(u), rtol=1e-4, atol=1e-5)


def test_gradients_are_those_of_finite_differences():
    shape, settings, tensors = CASES["channel"]

    def both(u, nu, inflow, speed):
        lid = torch.stack([speed, torch.zeros_like(speed)])  # through the wall must stay zero
        return torch.cat(flow("channel", F64, nu, {"inflow": inflow, "lid": lid}).step_and_pressure(u), 1)

    inputs = [
        0.5 * noise(2, 2, *shape),
        torch.tensor(settings["nu"], dtype=F64),
        tensors["inflow"],
        torch.tensor(0.3, dtype=F64),
    ]
    with Fibers():
        assert torch.autograd.gradcheck(both, [t.clone().requires_grad_() for t in inputs], fast_mode=True, atol=1e-6)


@pytest.mark.parametrize(("name", "cells"), [("cavity", 16384), ("box", CELLS)])
def test_bits_depend_neither_on_the_order_of_threads_nor_on_neighbours(name, cells):
    shape = CASES[name][0]
    u = noise(3, len(shape), *shape, seed=3, dtype=F32).mul_(0.5).requires_grad_()
    given = {key: t[:1] if t.dim() > 1 else t for key, t in CASES[name][2].items()}

    def run(u):
        states = flow(name, F32, given={key: t.to(F32) for key, t in given.items()}).rollout(u, 2)
        return states.detach(), *torch.autograd.grad(states.square().sum(), u)

    expected = run(u)
    with Fibers(cells=cells):
        wanted = run(u)
        alone = run(u[1:2])
    for mine, other in zip(wanted, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-3, atol=1e-3)
    assert all(torch.equal(one[0], all_[1]) for one, all_ in zip(alone, wanted, strict=True))
    for order in (BACKWARD, SHUFFLED):
        with Fibers(cells=cells, order=order):
            assert all(torch.equal(mine, other) for mine, other in zip(run(u), wanted, strict=True))


def test_the_barrier_before_a_gradient_is_needed():
    (barrier,) = barriers("flow")
    step, u = flow("periodic", F32), noise(2, 2, *PLANE, dtype=F32)
    found = []
    for left_out in (0, barrier):
        with torch.no_grad(), Fibers(order=BACKWARD, left_out=left_out):
            found.append(step.project(u))
    assert found[0].isfinite().all() and not torch.equal(*found)


@pytest.mark.parametrize("on_failure", ["return", "zero_grad", "warn", "raise"])
def test_samples_that_no_step_can_take_fail_alone(on_failure):
    u = 0.5 * noise(4, 2, *CASES["cavity"][0], seed=1)
    u[1] *= 1e4
    u[2, 0, 1, 1] = torch.nan

    def run():
        leaf = u.clone().requires_grad_()
        step = flow("cavity", on_failure=on_failure)
        states = step.rollout(leaf, 1)
        return states[:, 1].detach(), *torch.autograd.grad(states[:, 1].square().sum(), leaf), step.info

    said = "2 of 4 samples failed: sample 1 DIVERGED: dt .* sample 2 NONFINITE_INPUT: the velocity"
    if on_failure == "raise":
        with Fibers(), pytest.raises(torch.linalg.LinAlgError, match=said):
            run()
        return
    with pytest.warns(UserWarning, match=said) if on_failure == "warn" else contextlib.nullcontext():
        *expected, info = run()
    with Fibers(), pytest.warns(UserWarning, match=said) if on_failure == "warn" else contextlib.nullcontext():
        *found, report = run()
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-10)
        assert (mine[1:3] == 0).all() and mine[0].abs().max() > 0
    assert torch.equal(report.status, info.status)
    torch.testing.assert_close(report.residual, info.residual, rtol=1e-3, atol=1e-12)


def test_pieces_without_a_kernel_are_done_by_tensor_operations(monkeypatch):
    """Where no compiler is found, and some kernels are kept from before."""
    *expected, _, _ = outcome("channel")
    monkeypatch.setenv("PATH", "")
    with Fibers(threads=224):  # as no other test has
        os.environ["PRDP_GPU"] = "auto"
        with pytest.warns(UserWarning, match="no kernel on this device, so tensor operations take its place"):
            *found, _, _ = outcome("channel")
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-8, atol=1e-9)


def solves_of_step(name):
    """Of the pressure, of the balance, and of the diffusion."""
    shape, settings, _ = CASES[name]
    if settings.get("diffusion") == "explicit":
        return 1
    return 2 if name == "periodic" else 2 + len(shape)


@pytest.mark.parametrize("name", CASES)
def test_a_step_is_at_most_eight_launches_beside_its_solves(name):
    """Forward and back, alone and in a rollout. The gradient of ν in an implicit diffusion takes the way forth again,
    with its solves."""
    with_everything, leaves = with_leaves(name, on_failure="return")
    alone = flow(name, on_failure="return")
    is_implicit = CASES[name][1].get("diffusion") != "explicit"
    again, most_back = (solves_of_step(name) - 1, 11) if is_implicit else (0, 8)

    def counted(run):
        before = fibers.launches()
        with torch.autograd.profiler.profile() as profiler:
            found = run()
        names = [event.name for event in profiler.function_events if event.name.startswith("aten::")]
        computing = [n for n in names if n not in FREE]
        return found, fibers.launches() - before, computing

    with Fibers(poison=False) as fibers:
        for step, inputs, again_back, most in ((alone, leaves[:1], 0, 8), (with_everything, leaves, again, most_back)):
            warm = step(leaves[0])  # masks are made once, and the first results of kernels compared
            w = noise(*warm.shape, seed=2)
            torch.autograd.grad(warm, inputs, w)
            for steps in (1, 3):
                solves = steps * solves_of_step(name)
                states, forward, of_torch = counted(
                    lambda step=step, steps=steps: step(leaves[0]) if steps == 1 else step.rollout(leaves[0], steps)
                )
                of_states = w if steps == 1 else noise(*states.shape, seed=2)
                _, back, of_torch_back = counted(
                    lambda states=states, inputs=inputs, w=of_states: torch.autograd.grad(states, inputs, w)
                )
                back -= solves + steps * again_back
                assert forward - solves <= 8 * steps and back <= most * steps, (forward, back, solves)
                if step is alone and steps == 1:  # the operations of the solves are among them
                    most_of_torch = 16 if "inflow" in CASES[name][2] else 4
                    assert len(of_torch) <= most_of_torch and len(of_torch_back) <= 18, (of_torch, of_torch_back)


@pytest.mark.parametrize("name", ["explicit, upwind", "viscous", "implicit box"])
def test_the_gradient_of_a_force_is_no_launch_more(name):
    shape, _, tensors = CASES[name]
    force = tensors["force"].to(F64).requires_grad_()
    u = (0.5 * noise(2, len(shape), *shape, seed=1)).requires_grad_()
    step = flow(name, given={"force": force}, on_failure="return")
    found = []
    with Fibers() as fibers:
        for leaves in ([u], [u], [u, force]):
            state = step(u)
            before = fibers.launches()
            with torch.autograd.profiler.profile() as profiler:
                torch.autograd.grad(state, leaves, torch.ones_like(state))
            names = [event.name for event in profiler.function_events if event.name.startswith("aten::")]
            found.append((fibers.launches() - before, sum(n not in FREE for n in names)))
    _, (launches, of_torch), (with_force, of_torch_with_force) = found
    assert with_force == launches and of_torch_with_force <= of_torch + 2, found


def test_the_coarse_grids_of_the_pressure_are_made_once():
    """For all steps and their reverses: with multigrid, there are no more launches than without."""
    u = (0.5 * noise(2, 2, *PLANE, seed=1)).requires_grad_()
    w, launches = noise(2, 2, *PLANE, seed=2), []
    for cycles in (None, "multigrid"):
        solver = prdp.CG(200, rtol=1e-12, preconditioner=cycles)
        step = prdp.Flow(PLANE, dt=0.01, nu=0.01, diffusion="explicit", solver=solver, on_failure="return")
        expected = torch.autograd.grad(step(u), u, w)[0]
        with Fibers() as fibers:
            torch.autograd.grad(step(u), u, w)
            before = fibers.launches()
            found = torch.autograd.grad(step(u), u, w)[0]
            launches.append(fibers.launches() - before)
        assert step.info.way == "kernel"
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-10)
    assert launches[0] == launches[1]


def test_coarse_grids_of_a_captured_graph_are_its_own():
    """They are there once it runs, so no solve outside may take them; and it keeps none of theirs alive."""
    u = 0.5 * noise(2, 2, *PLANE, seed=1)
    solver = prdp.CG(200, rtol=1e-12, preconditioner="multigrid")

    def launches_of_steps(*captures):
        step = prdp.Flow(PLANE, dt=0.01, nu=0.01, diffusion="explicit", solver=solver, on_failure="return")
        counts = []
        for captured in captures:
            with Fibers(captures=captured) as fibers:
                before = fibers.launches()
                step(u)
                counts.append(fibers.launches() - before)
        return counts

    launches_of_steps(False)  # looks at the first result of a kernel
    first, second = launches_of_steps(False, False)
    assert second == first - 1
    assert launches_of_steps(True, False, True, False) == [first, first, first, second]


# Operations that compute nothing: memory, views, and reading a number of the host.
FREE = {
    f"aten::{name}"
    for name in (
        "empty", "empty_like", "empty_strided", "view", "narrow", "slice", "select", "transpose", "expand", "detach",
        "alias", "as_strided", "reshape", "unsqueeze", "squeeze", "detach_", "to", "item", "_local_scalar_dense",
        "contiguous", "permute", "flatten", "is_nonzero", "result_type", "resolve_conj", "resolve_neg", "lift_fresh",
        "unbind",
    )
}  # fmt: skip
