"""The controller against the decisions of the published code, and its rules."""

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from helpers import field, golden
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


@pytest.mark.parametrize("case", [i for i in range(44) if i not in THRESHOLD])
def test_decisions_equal_the_published_code(case):
    history = G["history"][case][: G["length"][case]]
    if not np.isfinite(history).all() or G["raised"][case]:
        return  # refused here by name: test_a_bad_metric_raises
    params = G["params"][case]
    if params[3] < 2:
        return
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


@pytest.mark.parametrize("make", [copy.copy, copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
@pytest.mark.parametrize("kind", ["prdp", "schedule"])
def test_a_copy_goes_on_like_the_original(kind, make):
    heat = prdp.Heat((5,), 1e-3, 1.0, prdp.Jacobi(1))
    if kind == "prdp":
        original = prdp.PRDPController([heat], window=1, delta=2, increment=3, maximum=50)
    else:
        original = prdp.LinearSchedule([heat], initial=2, increment=3, maximum=50)
    metrics = [1.0, 0.9, 0.9, 0.9, 0.5, 0.5, 0.5, 0.2, 0.2]
    for metric in metrics[:5]:
        original.step(metric)
    twin = make(original)
    assert type(twin) is type(original) and twin.settings == original.settings
    assert twin.state_dict() == original.state_dict() and original.max_iter > 2
    (stepper,) = twin.steppers
    assert (stepper is heat) == (make is copy.copy) and stepper.max_iter == twin.max_iter
    goes_on = [(twin.step(metric), twin.max_iter, stepper.max_iter) for metric in metrics[5:]]
    assert goes_on == [(original.step(metric), original.max_iter, heat.max_iter) for metric in metrics[5:]]


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
