"""A rollout whose steps hand their start on says so."""

import warnings

import pytest
import torch

import prdp_torch as prdp

F64 = torch.float64
N, DT = 40, 1e-7
X = (torch.arange(N, dtype=F64) + 0.5) / N
A = prdp.operators.Diffusion(torch.ones(1, N, dtype=F64), shift=1 / DT, boundary="flux")
WAVE = (1 + 0.5 * torch.cos(2 * torch.pi * X)).expand(3, 1, N)  # two waves: the start is scaled as suits best


def said(call):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call()
    return found, [str(w.message) for w in caught if "took no iteration" in str(w.message)]


def step(solver=None, **options):
    return prdp.ImplicitStep(A, lambda u: u / DT, solver or prdp.CG(100), **options)


def heat(**options):
    """A stepper whose rollout is one node."""
    return prdp.Heat((N,), nu=1.0, dt=DT, solver=prdp.CG(100), **options)


ZEROS_AT_ENDS = torch.sin(torch.pi * X) + 0.5 * torch.sin(3 * torch.pi * X)
STARTS = {step: WAVE, heat: ZEROS_AT_ENDS.expand(3, 1, N)}


@pytest.mark.parametrize("make", [step, heat])
def test_short_steps_from_the_state_are_said_with_what_they_leave_out(make, always):
    u = STARTS[make]
    states, told = said(lambda: make(start="state").rollout(u, 1000))
    _, silent = said(lambda: make(start="zero").rollout(u, 1000))
    tight = make(start="state")
    tight.rtol = 1e-12
    exact = tight.rollout(u, 1000)
    change = (exact[:, -1] - u).norm(dim=(1, 2)) / u.norm(dim=(1, 2))
    assert not silent and (states[:, -1] - u).norm() < 0.5 * (exact[:, -1] - u).norm()
    assert len(told) == 1 and "1000 of 1000 steps took no iteration" in told[0] and 'start="zero"' in told[0]
    lost = float(told[0].split("as much as ")[1].split(" ")[0])
    assert 0.2 * change.max() < lost < 3 * change.max()
    rtol = float(told[0].split("such as ")[1].split(". ")[0])
    tight.rtol = rtol
    found, silent = said(lambda: tight.rollout(u, 1000))
    assert not silent and (found[:, -1] - exact[:, -1]).norm() < 0.05 * (exact[:, -1] - u).norm()


def test_others_say_nothing(always):
    assert not said(lambda: step(start="state").rollout(WAVE, 7))[1]  # few steps
    assert not said(lambda: step(start="zero").rollout(WAVE, 100))[1]
    assert not said(lambda: step(start="state", on_failure="return").rollout(WAVE, 1000))[1]
    loose = step(prdp.CG(100), start="state")
    controller = prdp.ToleranceController([loose])  # which counts them itself
    assert loose.rtol == 1e-3 and not said(lambda: loose.rollout(WAVE, 1000))[1] and controller.warning is None
    assert not said(lambda: step(start="state").rollout(torch.ones_like(WAVE), 1000))[1]  # nothing is left out


@pytest.mark.parametrize("solver", [prdp.CG(100), prdp.CG(100, rtol=1e-4), prdp.CG(100, preconditioner="multigrid")])
@pytest.mark.parametrize("steps", [100, 1000])
def test_a_march_towards_a_steady_state_says_nothing(solver, steps, always):
    """It is there after a few steps, and rests for the others."""
    kappa = torch.ones(1, N, dtype=F64)
    march = prdp.ImplicitStep(prdp.operators.Diffusion(kappa, shift=1.0), lambda u: u + 1.0, solver, start="state")
    states, told = said(lambda: march.rollout(torch.zeros(1, 1, N, dtype=F64), steps))
    assert (march.info.iterations[:, -50:] == 0).all() and not told
    assert (states[:, -1] - states[:, -2]).abs().max() == 0


@pytest.mark.parametrize("rtol", [1e-5, 3e-5, 1e-4, 1e-3])
def test_a_cable_that_a_current_lifts_is_told_at_every_tolerance(rtol, always):
    """At rest at -65: the change of a step is far below the state. At 1e-5 one step in eight works, the first among
    them; at 1e-3 none does."""
    n, dt, rest = 100, 0.025, -65.0
    cable = prdp.operators.Diffusion(torch.full((1, n), 0.5, dtype=F64), 1 / dt + 0.1, boundary="flux", length=40.0)
    current = torch.zeros(1, 1, n, dtype=F64)
    current[..., :3] = 0.5
    start = torch.full((1, 1, n), rest, dtype=F64)
    lift = {}
    for begin in ("zero", "state"):
        march = prdp.ImplicitStep(cable, lambda u: u / dt + 0.1 * rest + current, prdp.CG(500, rtol), start=begin)
        states, told = said(lambda march=march: march.rollout(start, 1600))
        lift[begin] = float(states[0, -1, 0, 0]) - rest
        assert len(told) == (begin == "state")
    assert lift["state"] < 0.7 * lift["zero"]


def test_it_is_said_once():
    assert sum(len(said(lambda: step(start="state").rollout(WAVE, 2000))[1]) for _ in range(3)) <= 1
