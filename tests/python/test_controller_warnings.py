"""What a controller warns of: solves that make the error, take no iteration, or stall."""

import importlib
import warnings

import numpy as np
import pytest
import torch
from helpers import field, heat_step

import prdp_torch as prdp


def test_a_controller_warns_while_the_residual_makes_up_the_error():
    """K = 3 leaves a residual of about a fifth."""
    heat = heat_step()
    controller = prdp.LinearSchedule([heat], initial=3, increment=0, maximum=3)
    heat(field((30,)))
    residual = float(heat.info.residual.mean())
    controller.step(error=0.3)
    assert f"the solves stop at a residual of {residual:.1e} (K = 3), too far off" in controller.warning
    heat.max_iter = 25
    heat(field((30,)))
    controller.step(error=0.3)
    assert controller.warning is None


def test_failed_samples_do_not_hide_the_residual_of_the_others():
    u, residuals, warned = field((30,), 16), [], []
    for failed in (0, 1, 16):
        heat = prdp.Heat((30,), nu=1e-1, dt=1.0, solver=prdp.Jacobi(max_iter=2), on_failure="zero_grad")
        controller = prdp.ToleranceController([heat], maximum=3)
        heat(u.index_fill(0, torch.arange(failed), float("nan")))
        controller.step(0.01)
        residuals.append(controller.history[-1].residual)
        warned.append("the solves stop at a residual" in controller.warning)
        assert failed == 16 or residuals[-1] == float(heat.info.residual[failed:].mean())
    assert residuals[2] is None and warned == [True, True, False]


@pytest.mark.parametrize("failed", [0, 8, 9, 16])
@pytest.mark.parametrize("make", [prdp.ToleranceController, prdp.PRDPController])
def test_samples_that_fail_are_told_where_they_are_most(make, failed):
    heat = prdp.Heat((30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=99), on_failure="zero_grad")
    controller = make([heat])
    controller.step(1.0)
    heat(field((30,), 16).index_fill(0, torch.arange(failed), float("nan")))
    controller.step(0.9)
    told = "most samples of the last solves failed, and what is trained learns nothing" in (controller.warning or "")
    assert told == (failed > 8)
    heat(field((30,), 16))
    controller.step(0.8)
    assert "failed" not in (controller.warning or "")


def test_an_error_in_units_is_told():
    controller = prdp.ToleranceController()
    for k in range(20):
        assert controller.warning is None
        controller.step(30.0 - k / 10)
    assert "the error was 2.8e+01 at least in 20 intervals: is it relative" in controller.warning
    for k in range(3):
        controller.step(90.0 + k)
    assert "the error grows" in controller.warning and "relative" not in controller.warning
    controller.step(0.9)
    assert controller.warning is None
    relative = prdp.PRDPController()
    for k in range(40):
        relative.step(30.0 - k / 10)
    assert relative.warning is None  # its metric may have any unit


def test_a_tolerance_that_was_asked_for_is_no_warning():
    """For an error of 1 the controller asks for rtol = .1, whatever the error then is."""
    heat = heat_step()
    controller = prdp.ToleranceController([heat])
    controller.step(1.0)
    heat(field((30,)))
    assert 1e-2 < heat.info.residual.mean() <= 0.1
    controller.step(0.01)
    assert controller.warning is None
    controller.step(0.01)  # the solves still have the residual of then
    assert "the solves stop at a residual of" in controller.warning


def test_solves_that_take_no_iteration_are_told():
    heat = prdp.Heat((30,), nu=1e-4, dt=1.0, solver=prdp.CG(100))
    u = torch.randn(4, 1, 30, generator=torch.Generator().manual_seed(0)).cumsum(-1)
    controller = prdp.ToleranceController([heat])
    controller.step(1.0)
    for start, told in (("state", True), ("zero", False)):
        heat.start = start
        heat(u)
        controller.step(0.9)
        assert (int(heat.info.iterations.max()) == 0) == told
        assert ("took no iteration" in (controller.warning or "")) == told


def test_no_iterations_that_were_asked_for_are_not_told():
    heat = heat_step()
    controller = prdp.LinearSchedule([heat], initial=0, increment=0, maximum=1)
    heat(field((30,)))
    controller.step()
    assert heat.info.iterations.eq(0).all() and "took no iteration" not in (controller.warning or "")


def test_a_warning_that_lasts_is_said_though_the_controller_refines():
    heat = heat_step()
    heat(field((30,)))  # K = 1, which leaves a large residual
    controller = prdp.ToleranceController([heat])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        controller.step(1.0)
        for k in range(40):
            assert controller.step(0.9 * 0.97**k)  # refines in every interval
    assert len(said) == 1 and "the solves stop at a residual of" in str(said[0].message)


def test_without_an_error_prdp_warns_of_a_stalled_metric():
    heat = heat_step()
    controller = prdp.PRDPController([heat], delta=2, window=1)
    heat(field((30,)))
    for metric in (80.0, 40.0, 20.0):
        controller.step(metric)
    assert controller.warning is None  # it still falls
    for _ in range(3):
        controller.step(20.0)
    assert "PRDPController: the solves stop at a residual of" in controller.warning
    assert "the metric no longer falls" in controller.warning


class Foreign:
    """A solver of somebody else's, whose attributes have names of ours."""

    def __init__(self, **attributes):
        self.max_iter = 1
        vars(self).update(attributes)


@pytest.mark.parametrize("attributes", [
    {"converged": lambda: False}, {"converged": torch.tensor([True, True])}, {"info": {"its": 3}}, {"info": 3},
])  # fmt: skip
def test_names_that_mean_something_else_are_not_read(attributes):
    solver = Foreign(**attributes)
    controller = prdp.PRDPController([solver], window=1, delta=2)
    for _ in range(5):
        controller.step(1.0)
    assert solver.max_iter == controller.max_iter == 2


@pytest.mark.parametrize("yes", [True, 1, torch.tensor(True), np.bool_(True)])
def test_a_bool_of_any_library_is_believed(yes):
    solver = Foreign(converged=yes)
    controller = prdp.PRDPController([solver], window=1, delta=2)
    for _ in range(5):
        controller.step(1.0)
    assert solver.max_iter == 1


def test_a_warning_points_at_the_call_of_step():
    importlib.import_module("torch._dynamo")  # as every optimiser does; calls go through torch from then on
    controller = prdp.PRDPController()
    with pytest.warns(UserWarning, match="the metric grows") as said:
        for metric in range(1, 40):
            controller.step(float(metric))
    assert [warning.filename for warning in said] == [__file__]


@pytest.mark.parametrize("first, last", [(0.5, 0.98), (0.1, 0.95)])
def test_an_accuracy_is_told_from_an_error(first, last):
    controller = prdp.PRDPController([])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it is said aloud, too
        for epoch in range(40):
            controller.step(last + (first - last) * 0.9**epoch)
    assert "the metric grows" in controller.warning
    assert controller.warning.endswith("If larger is better, pass 1 - accuracy, or the like")


def test_a_metric_that_has_fallen_is_no_accuracy():
    controller = prdp.PRDPController([])
    for epoch in range(40):
        controller.step(0.5 + 0.4 * abs(epoch - 2) / 40)
    assert controller.warning is None


def test_a_stepper_that_another_controller_sets_is_told_of_once(always):
    heat = heat_step()
    first, second = prdp.PRDPController([heat], initial=3), prdp.PRDPController([heat], initial=20)
    with pytest.warns(UserWarning, match="PRDPController: a PRDPController sets this Heat, too: give a stepper one"):
        first.step(1.0)
    assert heat.max_iter == 3
    with pytest.warns(UserWarning, match="sets this Heat, too"):
        second.step(1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        first.step(1.0)
        del second
        prdp.ToleranceController([heat]).step(1.0)  # in place of both
        other = prdp.ToleranceController([heat])
        other.step(1.0)


def test_an_array_of_one_number_is_a_metric():
    controller = prdp.ToleranceController([])
    controller.step(np.array([0.5]))
    controller.step(torch.tensor([[0.25]]))
    assert [record.error for record in controller.history] == [0.5, 0.25]
    with pytest.raises(TypeError, match="error"):
        controller.step(np.array([0.5, 0.5]))
