"""`prdp.advise`: what it counts, what it leaves out, and what it refuses."""

import math
import re

import pytest
import torch
from helpers import field

import prdp_torch as prdp
from prdp_torch import _C, operators, solver_trials
from prdp_torch.operator_probes import random_cotangent
from prdp_torch.solver_trials import Row, Solve


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


def test_the_step_stays_as_it_is(heat):
    step, u, _ = heat
    assert (step.method, step.max_iter, step.backward, step.info) == ("jacobi", 1, "none", None)
    assert u.dtype == torch.float32 and not u.requires_grad


def test_burgers_leaves_out_what_needs_symmetry_or_a_known_spectrum():
    step = prdp.Burgers((64,), nu=1e-2, dt=1e-2, solver=prdp.GMRES(1, restart=5))
    advice = advise(step, field((64,), batch=2))
    assert {"Jacobi", "GMRES(5)", "GMRES(8)", "Direct"} <= {row.name for row in advice.rows}
    assert not {"CG", "Chebyshev"} & {row.name for row in advice.rows}
    assert any(
        note.endswith("SteepestDescent and CG and MINRES were not tried: A is not symmetric.") for note in advice.notes
    )
    assert any(note.startswith("Chebyshev was not tried: the spectrum is known of Heat") for note in advice.notes)


def test_a_function_without_diagonal_leaves_out_jacobi():
    function = prdp.operators.Function(lambda v: 3 * v + v.roll(1, -1))
    advice = advise(own_step(function), field((16,), batch=2))
    names = {row.name for row in advice.rows}
    assert {"GMRES(8)", "Direct"} <= names and "Jacobi" not in names
    assert any(re.match("Jacobi and .* were not tried: .*diagonal", note) for note in advice.notes)


def test_a_step_whose_tensors_do_not_follow_is_advised_in_its_own_dtype(monkeypatch):
    monkeypatch.setattr("prdp_torch.advice.candidates", lambda _: [prdp.Direct()])  # no times decide what is advised
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
    """Here the adjoint solve is STAGNATED after five cycles, while a forward solve is MAX_ITER and needs more."""
    generator = torch.Generator().manual_seed(0)
    kappa = (0.5 * torch.randn(1, 32, 32, generator=generator) - 3).exp()
    u = torch.randn(2, 1, 32, 32, generator=generator)
    diffusion = operators.Diffusion(kappa, shift=0.1, boundary=["flux", "periodic"])
    step, solver = prdp.ImplicitStep(diffusion, lambda u: u, prdp.Multigrid(1)), prdp.Multigrid(1)
    trial = solver_trials.Trial(step, u, torch.ones_like(u), False)
    solver_trials.set_solver(step, solver, 5, 1e-5)
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
