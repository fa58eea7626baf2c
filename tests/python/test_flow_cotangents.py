"""A flow whose loss is NaN in one sample: its neighbours keep their gradients, and so does what all share."""

import contextlib

import pytest
import torch
from fibers import Fibers
from test_gpu_flow import CASES, F64, flow, noise, with_leaves

import prdp_torch as prdp

WAYS = {"loops": contextlib.nullcontext, "kernels": Fibers}
ways = pytest.mark.parametrize("way", WAYS)


def gradients(name, way, nan, whole, **options):
    """Of everything, for a loss without sample 1, or with a NaN there."""
    with WAYS[way]():
        step, leaves = with_leaves(name, F64, **options)
        found = torch.cat(step.step_and_pressure(leaves[0]), 1) if whole else step.rollout(leaves[0], 3)
        weights = noise(*found.shape, seed=2)
        weights[1] = 0.0
        if nan:
            last = weights[1, -1]  # the pressure, or the last state
            last.view(-1)[3] = torch.nan
        return torch.autograd.grad(found, leaves, weights), step.adjoint_info


@pytest.mark.filterwarnings("ignore:.*their gradient is zero")
@ways
@pytest.mark.parametrize("on_failure", ["return", "zero_grad"])
@pytest.mark.parametrize("whole", [False, True], ids=["rollout", "step and pressure"])
@pytest.mark.parametrize("name", CASES)
def test_nan_in_the_cotangent_of_a_sample_stays_there(name, whole, on_failure, way):
    expected, _ = gradients(name, way, False, whole, on_failure=on_failure)
    found, info = gradients(name, way, True, whole, on_failure=on_failure)
    assert (found[0][1] == 0).all()
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-11)
    refused = info.status.eq(prdp.SolveStatus.NONFINITE_INPUT)
    assert refused.tolist() == ([False, True] if whole else [[False] * 3, [False, False, True]])
    assert info.residual[refused].isinf().all() and info.failed.sum() == 1


@ways
def test_the_error_names_step_sample_and_index(way):
    with WAYS[way]():
        step = flow("periodic")
        u = noise(2, 2, *CASES["periodic"][0]).requires_grad_()
        weights = torch.zeros(2, 6, 2, *CASES["periodic"][0], dtype=F64)
        weights[1, 3, 1, 4, 2] = torch.inf
        with pytest.raises(
            torch.linalg.LinAlgError, match=r"step 3 of 5: .*sample 1 NONFINITE_INPUT at index .*"
        ) as said:
            step.rollout(u, 5).backward(weights)
    if way == "loops":
        assert "at index (1, 4, 2): the cotangent is NaN or Inf there; look at the loss" in str(said.value)


@ways
def test_a_warning_says_the_same(way):
    with WAYS[way](), pytest.warns(UserWarning, match="sample 1 NONFINITE_INPUT at index"):
        step = flow("periodic", on_failure="warn")
        u = noise(2, 2, *CASES["periodic"][0]).requires_grad_()
        weights = torch.ones_like(u)
        weights[1, 0, 0, 0] = torch.nan
        (found,) = torch.autograd.grad(step(u), u, weights)
    assert found[0].abs().min() > 0 and (found[1] == 0).all()


def test_second_derivatives_leave_it_out_as_well():
    step = flow("cavity", on_failure="return")
    u = noise(2, 2, *CASES["cavity"][0]).requires_grad_()
    weights = noise(2, 2, *CASES["cavity"][0], seed=1)
    found = []
    for value in (0.0, torch.nan):
        of_one = weights.clone()
        of_one[1] = value
        (first,) = torch.autograd.grad(step(u), u, of_one, create_graph=True)
        found.append(torch.autograd.grad(first.square().sum(), u)[0])
    assert found[0][0].abs().max() > 0 and torch.equal(*found)


def test_many_cotangents_at_once():
    u = noise(2, 2, *CASES["periodic"][0])
    nu = torch.tensor(0.02, dtype=F64, requires_grad=True)
    pressure = flow("periodic", nu=nu, on_failure="return").step_and_pressure(u)[1]
    weights = noise(3, *pressure.shape, seed=1)
    (found,) = torch.autograd.grad(pressure, nu, weights, is_grads_batched=True, retain_graph=True)
    each = [torch.autograd.grad(pressure, nu, w, retain_graph=True)[0] for w in weights]
    torch.testing.assert_close(found, torch.stack(each), rtol=1e-10, atol=0)


@ways
def test_nan_in_the_cotangent_of_a_pressure_raises(way):
    with WAYS[way]():
        u = noise(2, 2, *CASES["cavity"][0]).requires_grad_()
        pressure = flow("cavity").step_and_pressure(u)[1]
        with pytest.raises(torch.linalg.LinAlgError, match=r"sample 1 NONFINITE_INPUT at index \(2, 0, 0\)"):
            pressure[1, 0, 0, 0].mul(torch.nan).backward()
