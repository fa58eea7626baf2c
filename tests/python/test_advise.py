"""`prdp.advise` and `prdp advise`: what they count, what they leave out, and what they recommend."""

import math
import re

import pytest
import torch
from helpers import field

import prdp_torch as prdp
from prdp_torch import _C, operators, solver_trials
from prdp_torch import advice as module
from prdp_torch.operator_probes import random_cotangent
from prdp_torch.solver_trials import Row, Solve, measure_with_start


def advise(step, sample, seconds=1.0, **options):
    return prdp.advise(step, sample, seconds=seconds, **options)


def own_step(operator, rhs=None):
    return prdp.ImplicitStep(operator, rhs, prdp.GMRES(1))


def rows(advice, name, dtype):
    return {row.rtol: row for row in advice.rows if row.name == name and row.dtype == dtype}


@pytest.fixture(scope="module")
def heat():
    step = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(1), backward="none")
    u = field((30,), batch=3, dtype=torch.float32)
    return step, u, advise(step, u)


def test_the_counts_are_those_of_the_solves(heat):
    step, u, advice = heat
    cotangent = random_cotangent(step, u)
    for name, solver in (("Jacobi", prdp.Jacobi), ("Chebyshev", prdp.Chebyshev), ("CG", prdp.CG)):
        for rtol, row in rows(advice, name, torch.float32).items():
            b = u.clone().requires_grad_()
            x, info = prdp.linear_solve(step.operator(u), b, solver(1000, rtol=rtol))
            x.backward(cotangent)
            for solve, truth in ((row.forward, info), (row.adjoint, info.adjoint)):
                assert solve.iterations == int(truth.iterations.max())
                assert solve.products == int(truth.operator_applications.max())
                assert solve.status == "CONVERGED" and solve.seconds > 0
    assert {row.rtol for row in advice.rows} == {1e-2, 1e-5}


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


def test_the_step_stays_as_it_is(heat):
    step, u, _ = heat
    assert (step.method, step.max_iter, step.backward, step.info) == ("jacobi", 1, "none", None)
    assert u.dtype == torch.float32 and not u.requires_grad


def test_burgers_leaves_out_what_needs_symmetry_or_a_known_spectrum():
    step = prdp.Burgers((64,), nu=1e-2, dt=1e-2, solver=prdp.GMRES(1, restart=5))
    advice = advise(step, field((64,), batch=2))
    assert {"Jacobi", "SteepestDescent", "GMRES(5)", "GMRES(8)", "Direct"} <= {row.name for row in advice.rows}
    assert not {"CG", "Chebyshev"} & {row.name for row in advice.rows}
    assert "CG was not tried: A is not symmetric." in advice.notes
    assert any(note.startswith("Chebyshev was not tried: the spectrum is known of Heat") for note in advice.notes)


def test_a_function_without_diagonal_leaves_out_jacobi():
    function = prdp.operators.Function(lambda v: 3 * v + v.roll(1, -1))
    advice = advise(own_step(function), field((16,), batch=2))
    names = {row.name for row in advice.rows}
    assert {"GMRES(8)", "Direct"} <= names and "Jacobi" not in names
    assert any(re.match("Jacobi and .* were not tried: .*diagonal", note) for note in advice.notes)


def test_a_step_whose_tensors_do_not_follow_is_advised_in_its_own_dtype():
    k = torch.full((16,), 2.0)
    step = own_step(lambda u: prdp.operators.Matrix(torch.diag(k)))
    advice = advise(step, torch.randn(2, 16), dtypes=(torch.float64,))
    assert any(note.startswith("float64 was not tried: ") for note in advice.notes)
    assert {row.dtype for row in advice.rows} == {torch.float32} and "Use " in advice.recommendation


def test_a_step_of_ones_own_sees_its_batch_and_its_dtype_alone():
    """Its functions may hold tensors of both."""
    seen = set()
    kappa = 1 + torch.rand(4, 1, 16, generator=torch.Generator().manual_seed(0))

    def operator(u):
        seen.add((tuple(u.shape), u.dtype))
        assert u.dtype == torch.float32
        return prdp.operators.Stencil(torch.cat([2 * kappa + 1, -kappa, -kappa], 1), [(0,), (-1,), (1,)])

    advice = advise(own_step(operator), field((16,), batch=4, dtype=torch.float32))
    assert seen == {((4, 1, 16), torch.float32)}
    assert rows(advice, "Direct", torch.float32)[1e-5].solved
    assert not any("Direct was not tried" in note or "float64" in note for note in advice.notes)
    assert {row.dtype for row in advice.rows} == {torch.float32}


def test_the_other_dtype_of_a_step_of_ones_own_is_tried_where_it_is_asked_for():
    step = prdp.ImplicitStep(lambda u: prdp.operators.Poisson((2000,)), None, prdp.CG(1))
    u = field((2000,), batch=1, dtype=torch.float32)
    asked = advise(step, u, seconds=0.2, dtypes=(torch.float64,))
    assert {row.dtype for row in asked.rows} == {torch.float32, torch.float64}
    alone = advise(step, u, seconds=0.2)
    assert any(note.startswith("Only the dtype of the sample was tried") for note in alone.notes)
    assert {row.dtype for row in alone.rows} == {torch.float32}
    built_in = advise(prdp.Poisson((2000,), prdp.CG(1)), u, seconds=0.2, dtypes=())
    assert {row.dtype for row in built_in.rows} == {torch.float32}
    for wrong in ((torch.float16,), "float64", torch.float64):
        with pytest.raises(ValueError, match=r"advise: dtypes must hold torch\.float32 and torch\.float64 only"):
            advise(step, u, dtypes=wrong)


def test_a_factorisation_of_the_batch_that_takes_too_long_is_left_out():
    kappa = torch.rand(40, 5, 60, 60, generator=torch.Generator().manual_seed(0)) + 0.1
    kappa[:, 0] += 10
    cross = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
    step = own_step(lambda u: prdp.operators.Stencil(kappa, cross))
    advice = advise(step, field((60, 60), batch=40, dtype=torch.float32), seconds=0.01)
    assert any(re.match(r"Direct was not tried: the batch takes some [\d.]+ s forward and", n) for n in advice.notes)


def test_a_solver_that_diverges_is_named():
    """0.1 I + 0.9 ones(3): positive definite, but Jacobi's spectral radius is 1.8."""
    step = own_step(0.1 * torch.eye(3, dtype=torch.float64) + 0.9)
    advice = advise(step, torch.randn(2, 3, dtype=torch.float64))
    jacobi = rows(advice, "Jacobi", torch.float64)
    assert jacobi.keys() == {1e-2} and jacobi[1e-2].status == "DIVERGED"
    assert re.search(r"Jacobi .* DIVERGED", str(advice)) and "Jacobi" not in advice.recommendation


def test_a_solver_that_takes_too_long_is_marked_and_bounded():
    """On 3000 points Jacobi needs tens of millions of iterations."""
    advice = advise(prdp.Poisson((3000,), prdp.CG(1)), field((3000,), batch=1), seconds=0.2)
    (jacobi,) = rows(advice, "Jacobi", torch.float64).values()
    assert jacobi.rtol == 1e-2 and jacobi.status == "MAX_ITER" and re.search(r"Jacobi .* time limit\n", str(advice))
    assert sum(solve.seconds for solve in jacobi.solves) < 2.0  # on a busy machine the forward solve takes it all
    assert rows(advice, "Direct", torch.float64)[1e-5].solved and "Direct" in advice.recommendation


def test_no_solver_is_recommended_where_none_gets_there():
    """A cyclic shift: Krylov methods stand still, and it has more unknowns than `Direct` may probe."""
    function = prdp.operators.Function(lambda v: v.roll(1, -1), lambda v: v.roll(-1, -1))
    advice = advise(own_step(function), field((5000,), batch=1), seconds=0.1)
    assert advice.rows and not any(row.solved for row in advice.rows)
    assert any(note.startswith("Direct was not tried: 5000 unknowns are too many") for note in advice.notes)
    assert advice.recommendation.startswith("No solver reaches 1e-2 within 0.1 s")


def test_a_solve_that_ends_at_its_rounding_counts_as_solved():
    """float32 cannot reach 1e-5 here; u is as accurate as the dtype allows."""
    advice = advise(prdp.Poisson((2000,), prdp.CG(1)), field((2000,), batch=1, dtype=torch.float32))
    coarse = rows(advice, "Direct", torch.float32)[1e-5]
    assert coarse.solved and coarse.forward.status == "STAGNATED"
    assert not advice.recommendation.startswith("No solver")
    assert any("is the rounding of float32" in note for note in advice.notes)


def test_a_pressure_gets_a_cotangent_that_can_be_solved_for():
    step = prdp.NavierStokes((8, 8), nu=1e-2, dt=1e-2, solver=prdp.GMRES(1, restart=8))
    u = prdp.fields.project(field((8, 8), batch=2, channels=3))
    cotangent = random_cotangent(step, u)
    assert float(cotangent[:, 2].mean((-2, -1)).abs().max()) < 1e-15 < float(cotangent[:, 0].mean().abs())
    found = rows(advise(step, u), "Direct", torch.float64)
    assert found[1e-5].solved


def test_gradients_of_parameters_count_though_the_state_has_none():
    k = torch.nn.Parameter(torch.tensor(2.0))
    step = own_step(prdp.operators.Function(lambda v, k: k * v, tensors=k, symmetric=True), torch.ones_like)
    advice = advise(step, field((5,), batch=1))
    assert all(row.adjoint is not None for row in advice.rows)
    constant = own_step(torch.eye(5, dtype=torch.float64), torch.ones_like)
    assert all(row.adjoint is None for row in advise(constant, field((5,), batch=1)[:, 0]).rows)


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


def stepper_with(kind):
    n = (12, 12)
    if kind == "a state":
        return prdp.ImplicitStep(lambda u: operators.Diffusion(0.1 + u[:, 0] ** 2, 1.0, "flux"), solver=prdp.CG(1))
    kappa = torch.rand(1, *n, dtype=torch.float64) + 0.1
    return prdp.ImplicitStep(operators.Diffusion(kappa.requires_grad_(kind == "weights"), 1.0), solver=prdp.CG(1))


@pytest.mark.parametrize("kind, made", [("a state", 3), ("weights", 3), ("neither", 1)])
def test_factors_are_made_anew_where_a_training_makes_them_anew(kind, made):
    """One for the batch, or for its only sample: each run makes what an update would have to make."""
    step, u = stepper_with(kind), torch.rand(1, 1, 12, 12, dtype=torch.float64)
    _C.clear_factorisations()
    trial = solver_trials.trial_of(step, u)
    solver_trials.set_solver(trial.step, prdp.Direct(), 1, 0.0)
    before = _C.count_factorisations()
    solver_trials.run(trial, prdp.Direct(), 3)
    assert _C.count_factorisations() - before == made
    told = "makes its factors or grids anew" if made == 3 else "made once and not counted"
    assert told in "".join(solver_trials.measure(step, u, [prdp.CG(1)], 0.1)[1])


class OwnForward(prdp.Stepper):
    def forward(self, u):
        return u


@pytest.mark.parametrize(
    "step, sample, error, message",
    [
        (torch.nn.Linear(3, 3), torch.ones(2, 3), TypeError, "step must be a Stepper such as Heat or ImplicitStep"),
        (
            OwnForward(prdp.CG(1)),
            torch.ones(2, 3),
            TypeError,
            r"a step of OwnForward is not one equation A\(u\) u_next = b\(u\), as it has no operator\(u\)",
        ),
        (prdp.Heat((8,), 1e-3, 1.0, prdp.CG(1)), None, TypeError, "sample must be a torch tensor, got NoneType"),
        (prdp.Heat((8,), 1e-3, 1.0, prdp.CG(1)), torch.ones(2, 1, 9), ValueError, r"\(batch, 1, 8\).*\(2, 1, 9\)"),
        (prdp.Heat((8,), 1e-3, 1.0, prdp.CG(1)), torch.ones(8), ValueError, r"states \(batch, channel, \*shape\)"),
        (prdp.Heat((8,), 1e-3, 1.0, prdp.CG(1)), torch.ones(0, 1, 8), ValueError, r"got \(0, 1, 8\) in torch.float32"),
        (prdp.Heat((8,), 1e-3, 1.0, prdp.CG(1)), torch.ones(2, 1, 8).int(), ValueError, "in float32 or float64"),
        (prdp.Heat((8,), 1e-3, 1.0, prdp.CG(1)), torch.full((2, 1, 8), torch.nan), ValueError, "holds NaN or Inf"),
    ],
)
def test_what_cannot_be_advised_on_is_refused_in_words(step, sample, error, message):
    with pytest.raises(error, match=message):
        prdp.advise(step, sample)


@pytest.mark.parametrize("seconds", [0, -1.0, math.nan, math.inf])
def test_the_limit_is_a_positive_number(seconds):
    with pytest.raises(ValueError, match="advise: seconds must be a number > 0"):
        prdp.advise(prdp.Heat((8,), 1e-3, 1.0, prdp.CG(1)), torch.ones(2, 1, 8), seconds)


def test_an_adjoint_at_its_rounding_does_not_end_the_trials_of_the_forward_solve():
    """Here the adjoint solve is STAGNATED after four cycles, while a forward solve is MAX_ITER and needs more."""
    generator = torch.Generator().manual_seed(0)
    kappa = (0.5 * torch.randn(1, 32, 32, generator=generator) - 3).exp()
    u = torch.randn(2, 1, 32, 32, generator=generator)
    diffusion = operators.Diffusion(kappa, shift=0.1, boundary=["flux", "periodic"])
    step, solver = prdp.ImplicitStep(diffusion, lambda u: u, prdp.Multigrid(1)), prdp.Multigrid(1)
    trial = solver_trials.Trial(step, u, torch.ones_like(u), False)
    solver_trials.set_solver(step, solver, 4, 1e-5)
    cut = solver_trials.run(trial, solver)
    assert (cut.forward.cut_off, cut.adjoint.cut_off, cut.status) == (True, False, "STAGNATED") and cut.may_go_on
    assert [row.solved for row in solver_trials._measure_one(trial, solver, 5.0)] == [True, True]


@pytest.mark.parametrize(
    ("status", "cut_off", "goes_on"),
    [("MAX_ITER", True, True), ("STAGNATED", True, True), ("STAGNATED", False, False), ("DIVERGED", True, False)],
)
def test_more_iterations_are_tried_where_samples_ran_out_of_them_and_none_failed(status, cut_off, goes_on):
    solve = Solve(1, 1, 1.0, status, False, cut_off)
    assert Row(prdp.CG(1), torch.float64, 1e-5, solve, None).may_go_on == goes_on


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


def test_a_varying_diagonal_is_divided_out():
    """With a contrast of 1000 between cells, the diagonal saves most of CG's iterations."""
    kappa = torch.exp(3.0 * torch.randn(16, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    values = 1.0 + 4.0 * kappa
    off = -0.2 * torch.ones_like(kappa)
    stencil = prdp.operators.Stencil(torch.stack([values, off, off])[None], [(0, 0), (0, 1), (0, -1)])
    found = {row.name: row for row in advise(own_step(lambda u: stencil), field((16, 16), batch=2)).rows}
    assert found["CG(diagonal)"].forward.products < 0.5 * found["CG"].forward.products


def test_direct_is_tried_on_a_large_grid_whose_operator_is_a_sum_over_the_axes():
    """As it needs no factorisation of the whole there; with a coefficient that varies it does."""
    shape = (180, 190)
    u = field(shape, batch=1, dtype=torch.float32)
    constant = torch.ones(1, *shape)
    varying = constant + torch.arange(shape[0])[:, None] % 3
    for kappa, tried in ((constant, True), (varying, False)):
        advice = advise(own_step(lambda v, kappa=kappa: prdp.operators.Diffusion(kappa, 1.0)), u, 0.3)
        assert any(row.name == "Direct" for row in advice.rows) == tried
        refused = "Direct was not tried: 34200 unknowns are too many to factorise within the limit; at most 32768."
        assert (refused in advice.notes) == (not tried)
