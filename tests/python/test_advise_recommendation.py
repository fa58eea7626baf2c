"""What `prdp.advise` recommends: which solver, whether to refine it, and from which start."""

import re

import pytest
import test_advise
import torch
from helpers import field
from test_advise import advise, own_step

import prdp_torch as prdp
from prdp_torch import advice as module
from prdp_torch.solver_trials import Row, Solve, measure_with_start

heat = test_advise.heat  # the fixture


def test_the_recommendation_names_the_fastest_solver_and_its_reason(heat):
    _, _, advice = heat
    fine = [row for row in advice.rows if row.rtol == 1e-5 and row.dtype == torch.float32 and row.solved]
    best = module.Update().choice(fine, 1e-5)
    assert best.name.split("(")[0] in advice.recommendation
    loosely = f"it is the fastest to 1e-2. With {re.escape(best.name)}, the fastest to 1e-5, a step takes"
    assert re.search(f"it is (the fastest|as fast as any) to 1e-5, and a step takes|{loosely}", advice.recommendation)
    assert {row.name for row in advice.rows if row.dtype == torch.float64} == {best.name}
    text = str(advice)
    assert "SteepestDescent" in text and text.endswith(advice.recommendation)


def test_no_solver_is_recommended_where_none_gets_there():
    """A cyclic shift: Krylov methods stand still, and it has more unknowns than `Direct` may probe."""
    function = prdp.operators.Function(lambda v: v.roll(1, -1), lambda v: v.roll(-1, -1))
    advice = advise(own_step(function), field((5000,), batch=1), seconds=0.1)
    assert advice.rows and not any(row.solved for row in advice.rows)
    assert any(note.startswith("Direct was not tried: 5000 unknowns are too many") for note in advice.notes)
    assert advice.recommendation.startswith("A search of 0.1 s found no solver that reaches 1e-2")


def made_up(name, rtol, seconds, iterations=10):
    solve = Solve(iterations, iterations + 1, seconds / 2, "CONVERGED", True)
    solver = {"CG": prdp.CG(1), "Direct": prdp.Direct(1), "Jacobi": prdp.Jacobi(1)}[name]
    return Row(solver, torch.float64, rtol, solve, solve)


@pytest.mark.parametrize(
    "seconds, network, words",
    [
        (1.0, 0.0, "Refine CG with a controller, up to K = 10: it is the fastest to 1e-5, and a step takes 1000 ms"),
        (1.0, 24.0, "Use converged solves with CG(max_iter=20, rtol=1e-5): it is the fastest to 1e-5, and physics is 4%"
         " of an update: 1000 ms of 25000 ms. Refinement has little to save: at most 4% of an update"),
        (1.0, 3.0, "Refine CG with a controller, up to K = 10: it is the fastest to 1e-5, and physics is 25% of an"),
    ],
)  # fmt: skip
def test_refinement_is_recommended_where_physics_is_a_large_part(seconds, network, words):
    step = prdp.Heat((8,), 1e-3, 1.0, prdp.CG(1))
    best = made_up("CG", 1e-5, seconds)
    text = module._recommend(step, field((8,)), [best], best, module.Update(network))
    assert text.startswith(words)


def test_the_direct_solver_says_whether_a_rough_solve_is_faster():
    best, equal, rough = (made_up(*row) for row in (("Direct", 1e-5, 1.0), ("Direct", 1e-2, 1.0), ("CG", 1e-2, 0.4)))
    update = module.Update(network=1.0)
    assert module._recommend(None, None, [best, equal], best, update) == (
        "Use the direct solver, Direct(): it is the fastest to 1e-5, and physics is 50% of an update: 1000 ms of "
        "2000 ms. Refinement has nothing to save: no solver is faster to 1e-2."
    )
    assert module._recommend(None, None, [best, equal, rough], best, update).endswith(
        "Refinement can save at most 30% of an update, as CG to 1e-2 takes 400 ms."
    )


def test_another_solver_is_refined_where_it_is_faster_to_a_loose_tolerance():
    """By more than the noise. Its K is what it takes to the finest one, where it reaches that."""
    best, rough = made_up("CG", 1e-5, 1.0, iterations=1), made_up("Jacobi", 1e-2, 0.4, iterations=3)
    update, finer = module.Update(), made_up("Jacobi", 1e-5, 1.5, iterations=20)
    words = (
        "Refine Jacobi with a controller, up to K = {}: it is the fastest to 1e-2. With CG, the fastest to 1e-5, "
        "a step takes 1000 ms with its adjoint. Refinement can save at most 60% of a step, "
        "as Jacobi to 1e-2 takes 400 ms."
    )
    assert module._recommend(None, None, [best, rough], best, update) == words.format(3)
    assert module._recommend(None, None, [best, rough, finer], best, update) == words.format(20)
    near = made_up("CG", 1e-2, 0.43)
    assert module._recommend(None, None, [best, near, rough], best, update).startswith("Use converged solves with CG")


def test_one_iteration_is_not_to_be_refined():
    best = made_up("CG", 1e-5, 1.0, iterations=1)
    text = module._recommend(None, None, [best], best, module.Update())
    assert text.startswith("Use converged solves with CG(max_iter=2, rtol=1e-5)")
    assert text.endswith("Refinement has nothing to save: one iteration is enough.")


def test_the_direct_solver_is_preferred_where_noise_decides():
    cg, direct, slow = (made_up(*row) for row in (("CG", 1e-5, 1.0), ("Direct", 1e-5, 1.05), ("Direct", 1e-5, 1.2)))
    update = module.Update()
    assert update.choice([cg, direct], 1e-5) is direct and update.choice([cg, slow], 1e-5) is cg
    assert update.choice([slow], 1e-5) is slow and update.choice([], 1e-5) is None
    assert "it is as fast as any to 1e-5" in module._recommend(None, None, [cg, direct], direct, update)


def test_the_gain_of_a_start_is_counted():
    """A state that a step hardly changes is a good start; one that has nothing to do with b is none."""
    x = torch.linspace(0.0, 1.0, 22, dtype=torch.float64)[1:-1]
    smooth, noise, solver = (x * (1 - x))[None, None], field((20,), batch=1), prdp.Jacobi(1000)
    heat = prdp.Heat((20,), nu=1e-2, dt=1.0, solver=solver)
    unrelated = prdp.ImplicitStep(heat.operator(smooth), lambda u: noise.flip(-1), solver)
    cases = (heat, smooth, 'pass start="state"'), (unrelated, noise, "keep the start from zero")
    for step, u, verdict in cases:
        solves = [prdp.linear_solve(heat.operator(u), step.rhs(u), solver, x0=x0) for x0 in (None, u)]
        zero, state = (int(info.operator_applications) for _, info in solves)
        row = Row(solver, u.dtype, 1e-5, Solve(zero, zero, 1.0, "CONVERGED", True), None)
        words = f"takes {state} products to 1e-5 in place of {zero}: {verdict}."
        assert (state < 0.9 * zero) == ("pass" in verdict)
        text = module._start_gain(row, measure_with_start(step, u, row))
        assert text == f"From the state, the forward solve of Jacobi {words}"


@pytest.mark.parametrize(("products", "verdict"), [(47, 'pass start="state"'), (48, "keep the start from zero")])
def test_a_start_is_recommended_where_it_saves_more_than_a_tenth(products, verdict):
    zero, state = (
        Row(prdp.CG(1), torch.float64, 1e-5, Solve(count, count, 1.0, "CONVERGED", True), None)
        for count in (53, products)
    )
    assert module._start_gain(zero, state).endswith(f"{products} products to 1e-5 in place of 53: {verdict}.")
