"""The controller against the decisions of the published code, its rules, and what holds for every controller."""

import copy
import math
import pickle
import warnings

import numpy as np
import pytest
import torch
from helpers import field, golden, heat_step
from hypothesis import given
from hypothesis import strategies as st

import prdp_torch as prdp

G = golden("should_refine")
# Where the published code divides by zero (a window of 1), or two constant histories sit on a threshold
# to the last bit and its powers of 1/(1 - α) tip them.
THRESHOLD = (32, 33, 34)


def decide(history, params, checkpoint, window):
    tau_step, tau_stop, _, delta = params
    controller = prdp.PRDPController(tau_step=tau_step, tau_stop=tau_stop, delta=int(delta), window=window)
    for value in history[:-1]:
        controller.step(value)
    state = controller.state_dict()
    controller.load_state_dict({**state, "checkpoint": float(checkpoint)})
    refined = controller.step(history[-1])
    return refined, controller.state_dict()["checkpoint"], controller.history[-1].smoothed


def decided(case):
    """Whether both decide: metrics that are no numbers, and delta = 1, are refused here (test_a_bad_metric_raises,
    test_bad_settings_raise_by_name)."""
    history = G["history"][case][: G["length"][case]]
    return np.isfinite(history).all() and not G["raised"][case] and G["params"][case][3] >= 2


@pytest.mark.parametrize("case", [i for i in range(44) if i not in THRESHOLD and decided(i)])
def test_decisions_equal_the_published_code(case):
    history = G["history"][case][: G["length"][case]]
    params = G["params"][case]
    window = int(params[2])
    checkpoint = G["checkpoint_in"][case]
    if window > 1:
        refined, after, smoothed = decide(history, params, checkpoint, window)
        assert refined == G["decision"][case]
        assert after == pytest.approx(G["checkpoint_out"][case], rel=1e-10)
        assert smoothed == pytest.approx(G["ema"][case][len(history) - 1], rel=1e-10)
    refined, after, _ = decide(history, params, checkpoint, window=1)
    assert refined == G["poisson_decision"][case]
    assert after == pytest.approx(G["poisson_checkpoint_out"][case], rel=1e-10)


@pytest.mark.parametrize("sequence", range(6))
def test_rolling_decisions_equal_the_published_code(sequence):
    tau_step, tau_stop, window, delta = G["seq_params"][sequence]
    controller = prdp.PRDPController(tau_step=tau_step, tau_stop=tau_stop, delta=int(delta), window=int(window))
    controller.load_state_dict({**controller.state_dict(), "checkpoint": float(G["seq_checkpoint0"][sequence])})
    history = G["seq_history"][sequence]
    controller.step(history[0])
    for epoch in range(80):
        assert controller.max_iter == G["seq_K"][sequence][epoch]
        assert controller.step(history[epoch + 1]) == G["seq_decision"][sequence][epoch]
        checkpoint = controller.state_dict()["checkpoint"]
        assert checkpoint == pytest.approx(G["seq_checkpoint"][sequence][epoch], rel=1e-10)


@given(st.lists(st.floats(0, 1e6), min_size=2, max_size=60))
def test_a_window_of_one_does_not_smooth(metrics):
    controller = prdp.PRDPController(window=1)
    for metric in metrics:
        controller.step(metric)
    assert [record.smoothed for record in controller.history] == metrics


def test_f02_a_constant_metric_refines_once():
    failures = golden("failures")
    controller = prdp.PRDPController()
    decisions = [controller.step(float(value)) for value in failures["F02_const__seq"]]
    assert sum(decisions) == 1


def test_k_goes_to_every_attached_stepper():
    heat = [prdp.Heat((5,), 1e-3, 1.0, solver=prdp.Jacobi(99)) for _ in range(2)]
    controller = prdp.PRDPController(heat, initial=4, window=1, delta=2)
    assert [h.max_iter for h in heat] == [4, 4]
    assert [controller.step(1.0) for _ in range(3)] == [False, False, True]
    assert [h.max_iter for h in heat] == [5, 5] and controller.max_iter == 5
    with pytest.raises(TypeError, match="a stepper must have max_iter"):
        prdp.PRDPController([torch.nn.Linear(2, 2)])


def test_k_stays_where_the_attached_solves_meet_their_tolerance():
    heat = prdp.Heat((5,), 1e-3, 1.0, solver=prdp.Jacobi(1))
    controller = prdp.PRDPController([heat], initial=200, window=1, delta=2)
    b = field((5,)).requires_grad_()
    heat(b).sum().backward()
    assert heat.converged
    assert not any(controller.step(1.0) for _ in range(10))
    coarse = prdp.PRDPController([heat], initial=1, window=1, delta=2)
    heat(b)
    assert not heat.converged
    assert any(coarse.step(1.0) for _ in range(10))


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=60), st.integers(1, 59))
def test_state_dict_restores_exactly(metrics, cut):
    settings = {"delta": 2, "window": 3, "maximum": 9, "growth": 1.5}
    whole, first, second = (prdp.PRDPController(**settings) for _ in range(3))
    decisions = [whole.step(m) for m in metrics]
    begun = [first.step(m) for m in metrics[:cut]]
    second.load_state_dict(first.state_dict())
    assert begun + [second.step(m) for m in metrics[cut:]] == decisions
    assert second.state_dict() == whole.state_dict()


def test_state_dict_survives_torch_save(tmp_path):
    controller = prdp.PRDPController(window=2)
    for metric in (3.0, 2.0, 2.0, 2.0):
        controller.step(metric)
    torch.save(controller.state_dict(), tmp_path / "state.pt")
    other = prdp.PRDPController(window=2)
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert other.state_dict() == controller.state_dict() and other.max_iter == controller.max_iter


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_a_bad_metric_raises_and_changes_nothing(bad):
    controller = prdp.PRDPController()
    controller.step(1.0)
    before = controller.state_dict()
    with pytest.raises(ValueError, match="PRDPController: metric must be finite and >= 0, got"):
        controller.step(bad)
    assert controller.state_dict() == before


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"delta": 1}, "delta must be >= 2, got 1"),
        ({"window": 0}, "window must be >= 1, got 0"),
        ({"initial": -1}, "initial must be >= 0, got -1"),
        ({"increment": 0}, "increment must be >= 1, got 0"),
        ({"maximum": 3, "initial": 4}, "maximum must be >= initial = 4, got 3"),
        ({"growth": 0.5}, "growth must be finite and >= 1, got 0.5"),
        ({"tau_step": math.nan}, "tau_step must be finite and > 0, got nan"),
        ({"tau_stop": 0.0}, "tau_stop must be finite and > 0, got 0"),
    ],
)
def test_bad_settings_raise_by_name(settings, message):
    with pytest.raises(ValueError, match=message):
        prdp.PRDPController(**settings)


def test_repr_and_history_can_be_read():
    controller = prdp.PRDPController(window=1, delta=2)
    assert "max_iter=1, smoothed metric none yet; tau_step=0.95" in repr(controller)
    for metric in (1.0, 1.0, 1.0):
        controller.step(metric)
    assert "max_iter=2, smoothed metric 1.000e+00" in repr(controller)
    last = controller.history[-1]
    assert (last.metric, last.smoothed, last.max_iter, last.refined) == (1.0, 1.0, 1, True)


@pytest.mark.parametrize("make", [prdp.PRDPController, prdp.ToleranceController])
def test_records_are_made_once_and_not_kept_from_another_state(make):
    """Else a loop that reads the last record takes a time that grows with the square of its length."""
    controller, other = make(), make()
    for metric in (1.0, 0.5, 0.4):
        controller.step(metric)
        seen = controller.history
    again = controller.history
    assert all(one is two for one, two in zip(again, seen, strict=True)) and len(again) == 3
    again.clear()  # a list of the caller's
    for metric in (3.0, 2.0, 1.0, 0.5):
        other.step(metric)
    assert [record[0] for record in controller.history] == [1.0, 0.5, 0.4]
    controller.load_state_dict(other.state_dict())
    assert controller.history == other.history and copy.deepcopy(controller).history == other.history


def test_the_manual_schedule_has_the_same_interface():
    heat = prdp.Heat((5,), 1e-3, 1.0, solver=prdp.Jacobi(1))
    schedule = prdp.LinearSchedule([heat], initial=25, increment=6, maximum=40)
    assert heat.max_iter == 25
    assert [schedule.step(0.5) for _ in range(4)] == [True, True, True, False]
    assert heat.max_iter == schedule.max_iter == 40
    other = prdp.LinearSchedule(initial=25, increment=6, maximum=40)
    other.load_state_dict(schedule.state_dict())
    assert other.max_iter == 40
    assert "max_iter=40; initial=25, increment=6" in repr(schedule)
    with pytest.raises(ValueError, match="maximum must be >= initial = 25, got 3"):
        prdp.LinearSchedule(initial=25, increment=6, maximum=3)


def test_a_copy_of_both_keeps_a_stepper_with_its_controller():
    heat = prdp.Heat((5,), 1e-3, 1.0, prdp.Jacobi(1))
    both = {"heat": heat, "controller": prdp.PRDPController([heat], window=1, delta=2)}
    for twin in (copy.deepcopy(both), pickle.loads(pickle.dumps(both))):
        assert twin["controller"].steppers[0] is twin["heat"] is not heat


def test_k_stops_at_the_largest_number():
    most = 2**63 - 1
    controller = prdp.PRDPController(window=1, delta=2, increment=most)
    schedule = prdp.LinearSchedule(initial=1, increment=most, maximum=most)
    assert [schedule.step(), schedule.step()] == [True, False] and schedule.max_iter == most
    assert [controller.step(1.0) for _ in range(4)] == [False, False, True, False]
    assert controller.max_iter == most
    steps = prdp.Burgers((8,), 1e-3, 1e-2, prdp.GMRES(1), picard_steps=4)
    with pytest.raises(
        ValueError, match=r"rollout: steps times picard_steps must be below 2\^63, got 2305843009213693953"
    ):
        steps.rollout(field((8,)), 2**61 + 1)
    # Huge budgets are no reason to run out of numbers when work is shared between threads.
    heat = prdp.Heat((8,), 1e-3, 1.0, prdp.GMRES(most, restart=most))
    assert heat.converged is False and torch.isfinite(heat(field((8,)))).all() and heat.converged


# ---- of every controller

CONTROLLERS = {
    "prdp": lambda steppers: prdp.PRDPController(steppers, window=2, adjoint_ratio=0.5),
    "tolerance": lambda steppers: prdp.ToleranceController(steppers, ratio=0.2),
    "schedule": lambda steppers: prdp.LinearSchedule(steppers, initial=2, increment=2, maximum=9, adjoint_ratio=0.3),
}
WAYS = {
    "state_dict": None,
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda controller: pickle.loads(pickle.dumps(controller)),
}


def budget_of(stepper):
    return stepper.max_iter, stepper.adjoint_max_iter, stepper.rtol, stepper.adjoint_rtol


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("way", WAYS)
def test_controllers_go_on_from_copies(name, way):
    heat = heat_step()
    controller = CONTROLLERS[name]([heat])
    heat(field((30,)))
    for metric in (0.9, 0.5, 0.5, 0.5, 0.5):
        controller.step(metric)
    if way == "state_dict":
        other = CONTROLLERS[name]([heat_step()])
        other.load_state_dict(controller.state_dict())
    else:
        other = WAYS[way](controller)
    assert type(other) is type(controller) and repr(other) == repr(controller)
    assert other.state_dict() == controller.state_dict() and other.warning == controller.warning
    assert budget_of(other.steppers[0]) == budget_of(heat)
    assert (other.steppers[0] is heat) == (way == "copy")
    metrics = (0.4, 0.4, 0.1, 0.1, 0.1)
    if way == "copy":  # both set one stepper
        warnings.filterwarnings("ignore", ".*: a .* sets this Heat, too")
    assert [other.step(m, converged=False) for m in metrics] == [controller.step(m, converged=False) for m in metrics]
    assert budget_of(other.steppers[0]) == budget_of(heat)


@pytest.mark.parametrize("ratio, k, share", [(0.34, 7, 3), (1 / 3, 9, 3), (1.0, 7, 7), (0.01, 7, 1)])
def test_the_adjoint_gets_its_share_of_k(ratio, k, share):
    heat = heat_step()
    prdp.PRDPController([heat], initial=k, adjoint_ratio=ratio)
    assert (heat.max_iter, heat.adjoint_max_iter) == (k, share)
    b = field((30,)).requires_grad_()
    heat(b).sum().backward()
    assert heat.info.iterations.tolist() == [k, k] and heat.adjoint_info.iterations.tolist() == [share, share]


def test_without_a_ratio_the_steppers_own_adjoint_budget_stays():
    heat = heat_step(adjoint_max_iter=4)
    controller = prdp.PRDPController([heat], initial=7)
    controller.step(1.0)
    assert (heat.max_iter, heat.adjoint_max_iter) == (7, 4)
    with pytest.raises(ValueError, match="PRDPController: adjoint_ratio must be > 0 and <= 1, got 2"):
        prdp.PRDPController(adjoint_ratio=2)
