"""`Flow` with an obstacle for each sample, (batch, *shape). Each sample has the result that it has alone."""

import contextlib
import copy
import functools

import pytest
import torch
from fibers import Fibers
from flows import by_other_ways
from helpers import statuses
from test_gpu_flow import BOX, F32, F64, PLANE, noise

import prdp_torch as prdp

WAYS = {"loops": contextlib.nullcontext, "kernels": Fibers}
WIDE = (7, 8)


def block(shape, *cells):
    solid = torch.zeros(shape, dtype=torch.bool)
    for cell in cells:
        solid[cell] = True
    return solid


def ring(shape):
    """A solid ring around a cell of fluid: a closed part of its own, whose pressure is known; and one around two."""
    solid = block(shape, (slice(1, 4), slice(1, 5)))
    solid[2, 2:4] = False
    return solid


CASES = {  # shape, an obstacle for each of three samples, settings
    "periodic": (PLANE, [block(PLANE, (2, 2)), block(PLANE, (1, 3), (4, 0)), block(PLANE, (2, slice(1, 4)))], {}),
    "cavity": (
        WIDE,
        [block(WIDE, (3, 3)), ring(WIDE), block(WIDE, (5, slice(2, 6)))],
        {"boundary": "wall", "wall_velocity": {(0, "high"): 1.0}, "nu": 0.7},
    ),
    "channel": (
        PLANE,
        [block(PLANE, (2, slice(2, 4))), block(PLANE, (1, 1), (3, 4)), block(PLANE, (0, 0))],
        {"boundary": ("wall", "open"), "inflow": noise(3, 2, 5, 1)},
    ),
    "pockets": (
        WIDE,
        [block(WIDE, (2, 2)), ring(WIDE), ring(WIDE).roll((2, 1), (0, 1))],
        {"boundary": ("wall", "open"), "inflow": torch.tensor([0.5, 0.0])},
    ),
    "explicit": (
        PLANE,
        [block(PLANE, (2, 2)), block(PLANE, (1, 3)), block(PLANE, (slice(2, 4), 4))],
        {"diffusion": "explicit", "advection": "upwind", "force": noise(3, 2, *PLANE)},
    ),
    "box": (BOX, [block(BOX, (1, 1, 1)), block(BOX, (1, 2, slice(1, 3))), block(BOX, (0, 0, 0))], {"boundary": "wall"}),
    "viscosities": (
        PLANE,
        [block(PLANE, (2, 2)), block(PLANE, (1, 3)), block(PLANE, (3, slice(2, 4)))],
        {"boundary": ("wall", "periodic"), "nu": torch.tensor([0.02, 0.3, 9.0], dtype=F64)},
    ),
}
names = pytest.mark.parametrize("name", CASES)
ALL = [0, 1, 2]


def outcome(name, samples, dtype=F64, together=True, graph=False, **options):
    """The states of two steps, the pressure of one, the projection, and the gradients of u and nu."""
    shape, solids, settings = CASES[name]
    settings = {"nu": 0.02, **settings}
    for key, t in settings.items():
        if isinstance(t, torch.Tensor):
            settings[key] = (t[samples] if t.shape[0] == 3 and len(shape) == 2 else t).to(dtype)
    nu = settings.pop("nu")
    nu = (nu.clone() if isinstance(nu, torch.Tensor) else torch.tensor(nu, dtype=dtype)).requires_grad_()
    u = (0.5 * noise(3, len(shape), *shape, seed=1, dtype=dtype))[samples].requires_grad_()
    obstacle = torch.stack(solids)[samples] if together else solids[samples[0]]
    rtol = 1e-13 if dtype == F64 else 1e-6
    step = prdp.Flow(shape, nu, 0.01, obstacle=obstacle, solver=prdp.CG(200, rtol=rtol), **settings, **options)
    found = step.rollout(u, 2), *step.step_and_pressure(u), step.project(u)
    weights = [noise(3, *t.shape[1:], seed=2, dtype=dtype)[samples] for t in found]
    u_bar, nu_bar = torch.autograd.grad(found, (u, nu), weights, create_graph=graph)
    assert step.info.solved.all()
    return [t.detach() for t in (*found, u_bar)], nu_bar.detach()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("dtype", [F32, F64], ids=["float32", "float64"])
@names
def test_each_sample_is_as_alone(name, dtype, way):
    with WAYS[way]():
        together, nu_bar = outcome(name, ALL, dtype)
        alone = [outcome(name, [i], dtype, together=False) for i in ALL]
    for k, all_samples in enumerate(together):
        assert torch.equal(all_samples, torch.cat([one[k] for one, _ in alone]))
    of_each = torch.stack([bar for _, bar in alone])
    if nu_bar.dim() == 1:
        assert torch.equal(nu_bar, of_each[:, 0])
    else:
        torch.testing.assert_close(nu_bar, of_each.sum(0), rtol=1e-5 if dtype == F32 else 1e-12, atol=0)


@names
def test_all_ways_agree(name):
    """Loops, kernels, the graph of second derivatives, and unrolled solves."""
    expected, expected_nu = outcome(name, ALL)
    for found, nu_bar in by_other_ways(functools.partial(outcome, name, ALL)):
        for mine, its in zip((*found, nu_bar), (*expected, expected_nu), strict=True):
            torch.testing.assert_close(mine, its, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("solver", [prdp.CG(60, preconditioner="multigrid"), prdp.Direct(), prdp.MINRES(200)], ids=repr)
def test_every_solver_knows_the_level_of_each_part(solver, way):
    """Of the second sample the cavity has two closed parts, of the others one; alone they take the same iterations."""
    shape, solids, settings = CASES["cavity"]
    u = noise(3, 2, *shape, seed=3)

    def run(obstacle, u):
        flow = prdp.Flow(shape, dt=0.01, obstacle=obstacle, solver=solver, **settings)
        return *flow.step_and_pressure(u), flow.info

    with WAYS[way]() if not isinstance(solver, prdp.Direct) else contextlib.nullcontext():
        v, p, info = run(torch.stack(solids), u)
        for i, solid in enumerate(solids):
            one_v, one_p, one_info = run(solid, u[[i]])
            torch.testing.assert_close((v[[i]], p[[i]]), (one_v, one_p), rtol=1e-9, atol=1e-11)
            assert abs(info.iterations[i] - one_info.iterations[0]) <= 1
    assert (info.status > 0).all()


def test_gradcheck():
    shape, solids, _ = CASES["pockets"]
    inflow = torch.tensor([0.5, 0.1], dtype=F64, requires_grad=True)
    nu = torch.tensor([0.05, 0.2, 0.1], dtype=F64, requires_grad=True)
    u = (0.3 * noise(3, 2, *shape)).requires_grad_()
    flow = prdp.Flow(shape, nu, 0.01, boundary=("wall", "open"), inflow=inflow, obstacle=torch.stack(solids),
                     solver=prdp.CG(200, 1e-13))  # fmt: skip

    def run(u, nu, inflow):
        flow.nu, flow.inflow = nu, inflow
        return flow.step_and_pressure(u)

    torch.autograd.gradcheck(run, (u, nu, inflow), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("form", ["incremental", "plain"])
@pytest.mark.parametrize("nu", [0.01, 2.0, 9.0])  # up to where a share of the pressure stays, with an obstacle or not
@pytest.mark.parametrize("boundary", ["periodic", "wall", ("wall", "open"), ("slip", "periodic")], ids=repr)
def test_a_sample_without_an_obstacle_is_the_box_alone(boundary, nu, form, way):
    solids = torch.stack([block(WIDE, (2, 2)), block(WIDE)])
    inflow = (0.3, 0.0) if "open" in boundary else None
    weights = noise(2, 3, *WIDE, seed=4)

    def run(obstacle, u, weights):
        viscosity = torch.tensor([nu], dtype=F64).expand(len(u)).clone().requires_grad_()
        step = prdp.Flow(WIDE, viscosity, 0.01, boundary=boundary, inflow=inflow, obstacle=obstacle, pressure=form,
                         solver=prdp.CG(200, 1e-13))  # fmt: skip
        u = u.clone().requires_grad_()
        found = torch.cat(step.step_and_pressure(step.project(u)), 1)
        return found.detach(), *torch.autograd.grad(found, (u, viscosity), weights)

    u = noise(2, 2, *WIDE)
    with WAYS[way]():
        both, alone = run(solids, u, weights), run(None, u[[1]], weights[[1]])
        other = run(solids[0], u[[0]], weights[[0]])
    for mine, empty, solid in zip(both, alone, other, strict=True):
        torch.testing.assert_close(mine[[1]], empty, rtol=1e-8, atol=1e-9)
        torch.testing.assert_close(mine[[0]], solid, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("way", WAYS)
def test_porous_samples_with_many_pockets_are_as_alone(way):
    """More closed parts than are taken off one by one."""
    shape = (12, 13)
    generator = torch.Generator().manual_seed(5)
    solids = torch.rand(3, *shape, generator=generator) < torch.tensor([0.5, 0.3, 0.0]).view(3, 1, 1)
    u = noise(3, 2, *shape)

    def run(obstacle, u):
        step = prdp.Flow(shape, 0.05, 0.01, boundary="wall", obstacle=obstacle, solver=prdp.CG(300, 1e-12))
        u = u.clone().requires_grad_()
        v, p = step.step_and_pressure(u)
        assert step.info.solved.all()
        return v, p, torch.autograd.grad(v.square().sum() + p.square().sum(), u)[0]

    with WAYS[way]():
        together = run(solids, u)
        for i in range(3):
            for mine, alone in zip(together, run(solids[i], u[[i]]), strict=True):
                torch.testing.assert_close(mine[[i]], alone, rtol=1e-7, atol=1e-8)


def test_a_sample_whose_step_is_too_long_leaves_its_neighbours_alone():
    shape, solids, settings = CASES["cavity"]
    obstacle = torch.stack(solids)
    u = 0.1 * noise(3, 2, *shape)
    u[1] *= 1e3
    flow = prdp.Flow(shape, dt=0.01, obstacle=obstacle, on_failure="return", **settings)
    v = flow(u)
    assert statuses(flow.info) == ["CONVERGED", "DIVERGED", "CONVERGED"] and (v[1] == 0).all()
    alone = prdp.Flow(shape, dt=0.01, obstacle=obstacle[[0, 2]], **settings)(u[[0, 2]])
    assert torch.equal(v[[0, 2]], alone)


def test_one_obstacle_of_a_batch_is_for_all_samples():
    solid = block(PLANE, (2, 2))
    u = noise(3, 2, *PLANE)
    one, other = (prdp.Flow(PLANE, 0.01, 0.01, obstacle=mask)(u) for mask in (solid, solid[None]))
    assert torch.equal(one, other)


def test_samples_are_counted_and_named():
    solids = torch.stack([block(PLANE, (2, 2)), ~block(PLANE)])
    with pytest.raises(ValueError, match="Flow: the obstacle of sample 1 fills the grid"):
        prdp.Flow(PLANE, 0.01, 0.01, obstacle=solids)
    with pytest.raises(ValueError, match=r"must have the shape of the grid, \[5, 6\], or \(batch or 1\) of them"):
        prdp.Flow(PLANE, 0.01, 0.01, obstacle=solids[None])
    flow = prdp.Flow(PLANE, 0.01, 0.01, obstacle=solids[[0, 0]])
    with pytest.raises(ValueError, match="Flow: obstacle holds 2 samples, u holds 3"):
        flow(noise(3, 2, *PLANE))
    none = prdp.Flow(PLANE, 0.01, 0.01, obstacle=solids[:0])
    assert none(noise(0, 2, *PLANE)).shape == (0, 2, *PLANE)


def test_obstacles_go_into_state_dicts_and_may_change():
    solids = torch.stack(CASES["periodic"][1])
    u = noise(3, 2, *PLANE)
    flow = prdp.Flow(PLANE, 0.01, 0.01, obstacle=solids)
    first = flow(u)
    other = prdp.Flow(PLANE, 0.01, 0.01, obstacle=torch.zeros_like(solids))
    other.load_state_dict(flow.state_dict())
    assert torch.equal(other(u), first)
    flow.obstacle = solids.flip(0)
    assert torch.equal(flow(u.flip(0)).flip(0), first)


def test_obstacles_that_are_set_for_a_batch_are_not_saved():
    """A network's model loads, and its average goes on, whatever the last batch was."""
    solids = torch.stack(CASES["periodic"][1])
    flow = prdp.Flow(PLANE, 0.01, 0.01)
    for samples in ([0, 1, 2], [0, 1]):
        flow.obstacle = solids[samples]
        assert torch.equal(flow.obstacle, solids[samples])
        flow(noise(len(samples), 2, *PLANE))
        assert "obstacle" not in flow.state_dict() and copy.deepcopy(flow).obstacle is None
    assert "obstacle=(2, 5, 6)" in repr(flow)
    flow.obstacle = solids[0]
    assert torch.equal(flow.state_dict()["obstacle"], solids[0]) and torch.equal(flow.obstacle, solids[0])
    flow.obstacle = solids
    assert torch.equal(copy.deepcopy(flow).obstacle, solids[0])
    flow.obstacle = None
    assert flow.obstacle is None and "obstacle" not in flow.state_dict()


def reached(solid, periodic, start):
    """The cells that fluid reaches from some, by walking."""
    found, todo = set(start), list(start)
    while todo:
        y, x = todo.pop()
        for step in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
            cell = tuple(c % n if wraps else c for c, n, wraps in zip(step, solid.shape, periodic, strict=True))
            inside = all(0 <= c < n for c, n in zip(cell, solid.shape, strict=True))
            if inside and not solid[cell] and cell not in found:
                found.add(cell)
                todo.append(cell)
    return found


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("boundary", ["periodic", "wall", ("wall", "open"), ("periodic", "open")], ids=repr)
def test_pockets_are_filled(boundary, seed):
    shape = (10, 12)
    is_open = "open" in boundary
    solids = torch.rand(4, *shape, generator=torch.Generator().manual_seed(seed)) < (0.2 if is_open else 0.35)
    flow = prdp.Flow(shape, 0.01, 1e-3, boundary=boundary, inflow=(0.5, 0.0) if is_open else None)
    filled = flow.fill_pockets(solids)
    names = (boundary,) * 2 if isinstance(boundary, str) else boundary
    periodic = [name == "periodic" for name in names]
    for solid, mask in zip(solids, filled, strict=True):
        assert (mask | ~solid).all()  # nothing opens
        fluid = [tuple(cell) for cell in (~solid).nonzero().tolist()]
        parts = []
        while fluid:
            parts.append(reached(solid, periodic, fluid[:1]))
            fluid = [cell for cell in fluid if cell not in parts[-1]]
        if is_open:
            ends = [{x for _, x in part} for part in parts]
            parts = [part for part, x in zip(parts, ends, strict=True) if 0 in x and shape[1] - 1 in x]
        else:
            parts = [max(parts, key=len)]
        kept = {tuple(cell) for cell in (~mask).nonzero().tolist()}
        assert kept == set().union(*parts)
        assert torch.equal(flow.fill_pockets(solid), mask)
    flow.obstacle = filled
    flow(0.1 * noise(4, 2, *shape))
    assert flow.info.solved.all()


def test_what_leaves_no_fluid_is_refused():
    flow = prdp.Flow(PLANE, 0.01, 0.01, boundary=("wall", "open"), inflow=(0.1, 0.0))
    with pytest.raises(ValueError, match="leaves no way from the open end to the other"):
        flow.fill_pockets(block(PLANE, (slice(None), 3)))
    with pytest.raises(ValueError, match="the obstacle fills the grid"):
        flow.fill_pockets(~block(PLANE))
    with pytest.raises(TypeError, match="obstacle must be a bool tensor"):
        flow.fill_pockets(torch.zeros(PLANE))
    with pytest.raises(ValueError, match=r"the shape of the grid, \[5, 6\], or \(batch or 1\) of them, got \[6, 5\]"):
        flow.fill_pockets(block((6, 5)))
    solids = block(PLANE, (0, 1), (1, 0))[None]  # a dead end at the inlet
    with pytest.raises(ValueError, match=r"make the cells before it solid, as with Flow\.fill_pockets"):
        flow.obstacle = solids
        flow(noise(1, 2, *PLANE))
    flow.obstacle = flow.fill_pockets(solids)
    flow(0.1 * noise(1, 2, *PLANE))
