"""start="state" of steppers and rollouts, and starts in opcheck, torch.compile, vmap and autocast."""

import pytest
import torch
from helpers import field, modes, random
from torch.library import opcheck

import prdp_torch as prdp
from prdp_torch import operators
from prdp_torch.solvers import packed_options

# ---- steppers and rollouts


def steppers(backward, **options):
    """name: (stepper from its viscosity, state)."""
    solve = {"backward": backward, "start": "state", "on_failure": "return", **options}
    return {
        "poisson": (lambda nu: prdp.Poisson((9,), prdp.CG(3), **solve), field((9,))),
        "heat": (lambda nu: prdp.Heat((9,), nu, 1.0, prdp.CG(3), **solve), field((9,))),
        "burgers_2d": (lambda nu: prdp.Burgers((4, 5), nu, 0.1, prdp.Jacobi(3), **solve), field((4, 5), channels=2)),
        "picard": (
            lambda nu: prdp.Burgers((9,), nu, 0.1, prdp.GMRES(1, restart=2), picard_steps=2, **solve), field((9,))
        ),
        "navier_stokes": (
            lambda nu: prdp.NavierStokes((4, 5), nu, 0.1, prdp.GMRES(2, restart=3), **solve),
            field((4, 5), channels=3),
        ),
        "own": (
            lambda nu: prdp.ImplicitStep(
                lambda u: operators.Burgers(u, nu, 0.1), lambda u: u - 0.1 * u**3, prdp.Jacobi(3), **solve
            ),
            field((9,)),
        ),
    }  # fmt: skip


def by_hand(stepper, u):
    """One step out of solves that are given their start."""
    b, last = stepper.rhs(u), u
    for _ in range(stepper.equation.picard_steps if isinstance(stepper, prdp.steppers.EquationStepper) else 1):
        solver = {"cg": prdp.CG, "jacobi": prdp.Jacobi, "gmres": prdp.GMRES}[stepper.method](stepper.max_iter)
        if isinstance(solver, prdp.GMRES):
            solver.restart = stepper.restart
        options = {"backward": stepper.backward, "on_failure": "return"}
        last, _ = prdp.linear_solve(stepper.operator(last), b, solver, x0=last, **options)
    return last


@modes
@pytest.mark.parametrize("name", steppers("none"))
def test_steps_and_rollouts_start_from_the_state(name, backward):
    make, state = steppers(backward)[name]
    bars = random(len(state), 4, *state.shape[1:], seed=3)
    results = []
    for way in ("by hand", "steps", "rollout"):
        nu = torch.tensor(1e-2, dtype=torch.float64, requires_grad=True)
        stepper, u = make(nu), state.clone().requires_grad_()
        if way == "rollout":
            states = stepper.rollout(u, 3)
        else:
            each = [u]
            for _ in range(3):
                each.append(by_hand(stepper, each[-1]) if way == "by hand" else stepper(each[-1]))
            states = torch.stack(each, 1)
        inputs = (u,) if name == "poisson" else (u, nu)
        results.append((states.detach(), *torch.autograd.grad(states, inputs, bars)))
    for other in results[1:]:
        for found, expected in zip(other, results[0], strict=True):
            assert torch.equal(found, expected)
    stepper.start = "zero"
    assert not torch.equal(stepper.rollout(state, 3), results[0][0])


@pytest.mark.parametrize("name, solver", [("heat", prdp.Jacobi), ("heat", prdp.Chebyshev), ("burgers", prdp.Jacobi)])
def test_starting_from_the_state_saves_products_on_trajectories(name, solver):
    x = torch.linspace(0, 1, 65)[:-1]
    u = torch.sin(2 * torch.pi * x)[None, None] + 0.3 * torch.cos(4 * torch.pi * x)
    products = {}
    for start in ("zero", "state"):
        if name == "heat":
            stepper = prdp.Heat((64,), 1e-3, 0.5, solver(500), start=start)
        else:
            stepper = prdp.Burgers((64,), 1e-2, 0.02, solver(500), start=start)
        stepper.rollout(u, 20)
        assert stepper.converged
        products[start] = int(stepper.info.operator_applications.sum())
    assert products["state"] < 0.85 * products["zero"], products


# ---- torch


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@modes
def test_the_ops_pass_opcheck(backward):
    b, x0 = field((5,)).requires_grad_(), field((5,), seed=1)
    nu = torch.tensor(1e-3, dtype=torch.float64, requires_grad=True)
    options = packed_options("cg", 3, 1e-5, 3, None, backward, start="state")
    equation = ([nu], "heat", [5], [0.1], 2)
    for op, arguments in (
        (torch.ops.prdp.linear_solve, (b, [nu], "heat", [5], [1.0], False, x0, *options)),
        (torch.ops.prdp.step, (b, *equation, *options)),
        (torch.ops.prdp.rollout_solves, (b, *equation, 4, *options)),
        (torch.ops.prdp.rollout, (b, *equation, 2, *options)),
    ):
        assert set(opcheck(op.default, arguments).values()) == {"SUCCESS"}


@modes
def test_compiled_and_checkpointed_steps_start_from_the_state(backward):
    torch._dynamo.reset()
    for name in ("heat", "own"):
        make, state = steppers(backward)[name]
        eager = make(1e-2)
        compiled = torch.compile(eager, fullgraph=True, backend="aot_eager")
        gradients = []
        for step in (eager, compiled, lambda u: torch.utils.checkpoint.checkpoint(eager, u, use_reentrant=False)):  # noqa: B023
            u = state.clone().requires_grad_()
            (step(u) ** 2).sum().backward()
            gradients.append(u.grad)
        assert torch.equal(gradients[0], gradients[1]) and torch.equal(gradients[0], gradients[2])


@modes
def test_vmap_maps_a_start(backward):
    a, b, x0 = operators.Heat((6,), 1e-3, 1.0), random(4, 2, 1, 6), random(2, 1, 6, seed=1)

    def solve(b, x0):
        return prdp.linear_solve(a, b, prdp.CG(2), backward=backward, x0=x0)[0]

    several = random(4, 2, 1, 6, seed=2)
    for dims, starts in (((0, None), [x0] * 4), ((0, 0), several), ((0, 1), several)):
        given = x0 if dims[1] is None else several.movedim(0, dims[1])
        expected = torch.stack([solve(*pair) for pair in zip(b, starts, strict=True)])
        assert torch.equal(torch.vmap(solve, dims)(b, given), expected)
    of_start = torch.vmap(solve, (None, 0))(b[0], several)
    assert torch.equal(of_start, torch.stack([solve(b[0], x) for x in several]))

    def loss(b):
        return solve(b, x0).square().sum()

    mapped = torch.vmap(torch.func.grad(loss))(b)
    torch.testing.assert_close(mapped, torch.stack([torch.func.grad(loss)(one) for one in b]))


def test_autocast_takes_low_precision_for_a_start():
    step = prdp.ImplicitStep(operators.Heat((9,), 1e-3, 1.0), None, prdp.CG(3), start="state")
    u = field((9,), dtype=torch.bfloat16)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = step(u)
    assert torch.equal(found, step(u.float()))
