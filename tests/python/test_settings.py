"""What is set after construction counts, or is refused; nothing is ignored in silence."""

import copy
import re

import pytest
import torch

import prdp_torch as prdp
from prdp_torch import operators


def heat(dt=0.5, length=1.0, **options):
    return prdp.Heat((30,), 1e-2, dt, prdp.CG(200, rtol=1e-12), length=length, **options)


STEPS = {
    "heat": (heat, (2, 1, 30)),
    "burgers": (lambda dt=0.5, length=1.0: prdp.Burgers((12,), 1e-2, dt, prdp.Direct(), length=length), (2, 1, 12)),
    "navier_stokes": (
        lambda dt=0.5, length=1.0: prdp.NavierStokes((6, 6), 1e-1, dt, prdp.Direct(), length=length), (2, 3, 6, 6)
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize("changed", [{"dt": 0.1}, {"length": 3.0}, {"length": 2.0, "dt": 0.2}, {"length": 1}])
def test_dt_and_length_count_when_they_are_set(name, changed):
    make, shape = STEPS[name]
    u = 0.1 * torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    step = make()
    before = step(u)
    for key, value in changed.items():
        setattr(step, key, value)
    other = make(**changed)
    assert torch.equal(step(u), other(u)) and torch.equal(step.rollout(u, 2), other.rollout(u, 2))
    assert (step.dt, step.length, repr(step)) == (other.dt, other.length, repr(other))
    assert torch.equal(step(u), before) == (changed == {"length": 1})
    assert torch.equal(copy.deepcopy(step)(u), other(u))


def test_picard_steps_count_when_they_are_set():
    u = torch.randn(2, 1, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    step, other = (prdp.Burgers((12,), 1e-2, 0.5, prdp.Direct(), picard_steps=n) for n in (1, 3))
    step.picard_steps = 3
    assert torch.equal(step(u), other(u))


def test_what_is_refused_or_changed_leaves_copies_alone():
    step = heat()
    twin = copy.copy(step)
    twin.dt = 0.1
    assert (step.dt, twin.dt) == (0.5, 0.1)
    sides = [2.0]
    stretched = heat(length=sides)
    sides[0] = 3.0
    assert stretched.length == (2.0,)


def test_smoothing_counts_in_calls_as_in_rollouts():
    solver = prdp.CG(50, rtol=1e-10, preconditioner=prdp.Multigrid(1, smoothing=1))
    step, u = prdp.Poisson((31, 31), solver), torch.ones(1, 1, 31, 31, dtype=torch.float64)
    step(u)
    many = step.info.iterations.item()
    step.preconditioner.smoothing = 6
    step(u)
    assert step.info.iterations.item() < many
    step.rollout(u, 1)
    few = step.info.iterations.item()
    step(u)
    assert step.info.iterations.item() == few


def test_subclasses_of_a_user_keep_what_they_are_made_of():
    class Own(prdp.Heat):
        def __init__(self, shape, dt):
            super().__init__(shape, 1e-2, dt, prdp.CG(5))
            self.shape, self.dt, self.state, self.stats = shape, dt, None, {}

    class OwnStencil(operators.Stencil):
        def __init__(self, width):
            super().__init__(torch.ones(1, 2, 4), [(0,), (1,)])
            self.width = width

    class OwnController(prdp.PRDPController):
        def __init__(self, steppers, delta):
            super().__init__(steppers, delta=delta)
            self.delta = delta

    assert Own((30,), 0.5).dt == 0.5 and OwnStencil(3).width == 3 and OwnController([], 3).delta == 3


def test_advise_takes_steps_that_keep_checkpoints():
    step = heat(backward="unrolled", checkpoint_every="sqrt")
    assert prdp.advise(step, torch.randn(2, 1, 30), seconds=0.2).rows
    assert (step.backward, step.checkpoint_every) == ("unrolled", "sqrt")


def test_the_length_of_poisson_counts_when_it_is_set():
    step, b = prdp.Poisson((9,), prdp.Direct()), torch.ones(1, 1, 9)
    u = step(b)
    step.length = 2.0
    torch.testing.assert_close(step(b), 4 * u)  # Δu = -p is of second order
    assert not hasattr(step, "dt")


@pytest.mark.parametrize("name, value, error, words", [
    ("dt", -1.0, ValueError, "Heat: dt must be finite and > 0, got -1"),
    ("dt", "a", TypeError, "Heat: dt must be a real number, got 'a'"),
    ("length", (1.0, 2.0), ValueError, "Heat: length must be one number or one per axis, 1 here"),
    ("length", 0.0, ValueError, "Heat: length must be finite and > 0, got [0]"),
    ("shape", (5,), AttributeError, "Heat: shape cannot be set later; make a new stepper"),
    ("dt", torch.nn.Parameter(torch.tensor(0.1)), TypeError, "Heat: dt must be a real number, got Parameter"),
    ("restart", "x", TypeError, "Heat: restart must be a whole number, got 'x'"),
    ("restart", 0, ValueError, "Heat: restart must be >= 1, got 0"),
    ("preconditioner", "foo", ValueError,
     "Heat: unknown preconditioner 'foo'; allowed: None, 'diagonal', 'multigrid', or an operator"),
    ("preconditioner", 5, TypeError, "Heat: preconditioner must be a name or an operator"),
    ("adjoint_max_iter", "x", TypeError, "Heat: adjoint_max_iter must be a whole number, got 'x'"),
    ("backward", "implict", ValueError, "backward: unknown name 'implict'; allowed: implicit, unrolled, none"),
    ("on_failure", "rise", ValueError, "on_failure: unknown name 'rise'; allowed: raise, warn, return, zero_grad"),
    ("checkpoint_every", "log", TypeError, "Heat: checkpoint_every must be a whole number, 'sqrt' or None, got 'log'"),
    ("rtol", 2.0, ValueError, "Heat: rtol must be < 1, got 2"),
    ("adjoint_rtol", 1.0, ValueError, "Heat: adjoint_rtol must be < 1, got 1"),
])  # fmt: skip
def test_a_wrong_value_is_refused_when_it_is_set_and_changes_nothing(name, value, error, words):
    step, u = heat(), torch.randn(1, 1, 30)
    before, kept = step(u), getattr(step, name)
    with pytest.raises(error, match=re.escape(words)):
        setattr(step, name, value)
    assert getattr(step, name) == kept and torch.equal(step(u), before)


@pytest.mark.parametrize("make", [
    lambda: prdp.CG(5, rtol=1.0),
    lambda: heat(adjoint_rtol=1.5),
    lambda: prdp.linear_solve(torch.eye(3), torch.ones(3), prdp.CG(5), adjoint_rtol=1.0),
])  # fmt: skip
def test_a_tolerance_that_zero_meets_is_refused(make):
    with pytest.raises(ValueError, match=r"rtol must be < 1, got 1.*; u = 0 would meet it"):
        make()


OPERATORS = {
    "diffusion": (lambda: operators.Diffusion(torch.ones(1, 4), shift=1.0), ("kappa", "shift", "boundary", "length")),
    "heat": (lambda: operators.Heat((4,), 1e-2, 1.0), ("nu", "dt", "length")),
    "stencil": (lambda: operators.Stencil(torch.ones(1, 2, 4), [(0,), (1,)]), ("coefficients", "offsets", "boundary")),
    "function": (lambda: operators.Function(lambda v: v), ("matvec", "diagonal", "symmetric")),
}


@pytest.mark.parametrize("name", OPERATORS)
def test_an_operator_stays_as_it_was_made(name):
    make, arguments = OPERATORS[name]
    a = make()
    for argument in arguments:
        with pytest.raises(AttributeError, match=f"{type(a).__name__}: {argument} cannot be set later"):
            setattr(a, argument, 2.0)
    a.label = "mine"
    assert a.label == "mine"


CONTROLLERS = {
    "PRDPController": (prdp.PRDPController, "tau_step"),
    "ToleranceController": (prdp.ToleranceController, "ratio"),
    "LinearSchedule": (lambda s: prdp.LinearSchedule(s, initial=1, increment=1, maximum=5), "maximum"),
}


@pytest.mark.parametrize("name", CONTROLLERS)
def test_settings_of_a_controller_stay_and_its_state_is_its_own(name):
    make, setting = CONTROLLERS[name]
    controller = make([heat()])
    with pytest.raises(AttributeError, match=f"{name}: {setting} cannot be set later; make a new controller"):
        setattr(controller, setting, 0.5)
    controller.step(0.5)
    for other in CONTROLLERS:
        step = heat()
        another = CONTROLLERS[other][0]([step])
        before = another.state_dict(), step.max_iter, step.rtol
        if other == name:
            another.load_state_dict(controller.state_dict())
            assert another.state_dict() == controller.state_dict()
            continue
        with pytest.raises(ValueError, match=f"{other}: expected its own state, got one of a {name}"):
            another.load_state_dict(controller.state_dict())
        assert (another.state_dict(), step.max_iter, step.rtol) == before


@pytest.mark.parametrize("steps", [None, 2])
@pytest.mark.parametrize("make, shape", [
    (heat, (2, 1, 30)),
    (lambda: prdp.ImplicitStep(operators.Heat((30,), 1e-2, 0.5), None, prdp.CG(200)), (2, 1, 30)),
    (lambda: prdp.Flow((6, 6), 0.1, 0.01), (2, 2, 6, 6)),
], ids=["heat", "implicit", "flow"])  # fmt: skip
def test_a_step_that_raises_leaves_no_report_of_an_earlier_one(make, shape, steps):
    step, u = make(), 0.1 * torch.randn(shape)
    call = step if steps is None else lambda v: step.rollout(v, steps)
    call(u)
    assert step.info is not None and step.converged
    u[1].view(-1)[3] = torch.nan
    with pytest.raises(torch.linalg.LinAlgError, match="NONFINITE_INPUT"):
        call(u)
    assert step.info is None and not step.converged


def test_steps_made_without_memory_get_their_values_later():
    """As large models are made: on the meta device, then emptied on the real one and loaded."""
    with torch.device("meta"):
        kappa = torch.nn.Parameter(torch.empty(1, 8, 8))
        field = prdp.ImplicitStep(operators.Diffusion(kappa, shift=1.0), None, prdp.CG(20))
        heat = prdp.Heat((8,), nu=0.1, dt=0.1, solver=prdp.CG(20))
        flow = prdp.Flow((8, 8), nu=0.1, dt=0.01)
    field.to_empty(device="cpu").load_state_dict({"operator_at.kappa": torch.ones(1, 8, 8)})
    u = torch.rand(1, 1, 8, 8)
    expected, _ = prdp.linear_solve(operators.Diffusion(torch.ones(1, 8, 8), shift=1.0), u, prdp.CG(20))
    torch.testing.assert_close(field(u), expected)
    u = torch.rand(1, 1, 8)
    torch.testing.assert_close(heat.to_empty(device="cpu")(u), prdp.Heat((8,), nu=0.1, dt=0.1, solver=prdp.CG(20))(u))
    u = torch.rand(1, 2, 8, 8)
    torch.testing.assert_close(flow.to_empty(device="cpu")(u), prdp.Flow((8, 8), nu=0.1, dt=0.01)(u))
