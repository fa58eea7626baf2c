"""The controller that ties the tolerance of a solve to the error: its rule, its history, and what it refuses."""

import math

import pytest
import torch
from helpers import field, heat_step
from hypothesis import given
from hypothesis import strategies as st

import prdp_torch as prdp


@pytest.mark.filterwarnings("ignore:.*the error grows")
@given(st.lists(st.floats(0, 10), max_size=30))
def test_the_tolerance_is_the_ratio_of_the_smallest_error_within_its_bounds(errors):
    heat = heat_step()
    controller = prdp.ToleranceController([heat], ratio=0.2, adjoint_ratio=0.25, floor=1e-3)
    for i in range(len(errors) + 1):
        expected = max(1e-3, 0.2 * min([1.0, *errors[:i]])) if i else 1e-3  # as nothing is known
        assert heat.rtol == controller.rtol == pytest.approx(expected)
        assert (
            heat.adjoint_rtol == controller.adjoint_rtol == pytest.approx(max(1e-2, expected, min(0.1, 4 * expected)))
        )
        assert (heat.max_iter, heat.adjoint_max_iter) == (10000, 2500)
        if i < len(errors):
            assert controller.step(errors[i]) == (controller.rtol < expected)


def test_solves_meet_what_the_tolerance_controller_asks_for():
    heat = heat_step()
    controller = prdp.ToleranceController([heat])
    controller.step(torch.tensor(0.05))  # a tensor of one element is a number
    b = field((30,)).requires_grad_()
    heat(b).sum().backward()
    assert heat.info.residual.max() <= 5e-3 < heat.adjoint_info.residual.max() <= 5e-2
    assert heat.converged and controller.warning is None


def test_the_history_of_tolerances():
    heat = heat_step()
    controller = prdp.ToleranceController([heat])
    heat(field((30,)))
    assert [controller.step(error) for error in (2.0, 0.5, 0.6)] == [False, True, False]
    first, second, third = controller.history
    assert (second.error, second.smallest, second.rtol, second.tightened) == (0.5, 0.5, 0.1, True)
    assert (third.smallest, third.rtol) == (0.5, 0.05)
    assert first.residual == pytest.approx(float(heat.info.residual.mean()))
    assert "ToleranceController(rtol=5.0e-02, adjoint_rtol=1.0e-01; ratio=0.1" in repr(controller)


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_a_bad_error_raises_and_changes_nothing(bad):
    controller = prdp.ToleranceController()
    controller.step(0.5)
    before = controller.state_dict()
    with pytest.raises(ValueError, match="ToleranceController: error must be finite and >= 0, got"):
        controller.step(bad)
    assert controller.state_dict() == before
    with pytest.raises(TypeError, match="error must be a real number, got 'small'"):
        controller.step("small")


@pytest.mark.parametrize(
    "settings, error, message",
    [
        ({"ratio": 1.0}, ValueError, "ratio must be > 0 and < 1, got 1"),
        ({"ratio": math.nan}, ValueError, "ratio must be > 0 and < 1, got nan"),
        ({"adjoint_ratio": 0}, ValueError, "adjoint_ratio must be > 0 and <= 1, got 0"),
        ({"floor": 0.0}, ValueError, "floor must be > 0 and < 1, got 0"),
        ({"maximum": 0}, ValueError, "maximum must be >= 1, got 0"),
        ({"maximum": 1.5}, TypeError, "maximum must be a whole number, got 1.5"),
        (
            {"tau_step": 0.9},
            TypeError,
            "unknown setting 'tau_step'; allowed: ratio, adjoint_ratio, floor, adjoint_floor, maximum",
        ),
    ],
)
def test_bad_settings_of_a_tolerance_raise_by_name(settings, error, message):
    with pytest.raises(error, match=message):
        prdp.ToleranceController(**settings)


def test_a_stepper_without_a_tolerance_is_refused():
    class Step:
        max_iter = adjoint_max_iter = 3

    with pytest.raises(TypeError, match="ToleranceController: a stepper must have rtol"):
        prdp.ToleranceController([Step()])
