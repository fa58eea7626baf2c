"""`advise` on a device, by the stand-in and over the fibers."""

import os
import time

import pytest
import torch
from fibers import Fibers
from stand_in_device import StandIn
from test_direct_on_devices import FIVE, box, random

import prdp_torch as prdp
from prdp_torch import advice, operators, solver_trials

F64 = torch.float64


@pytest.fixture(autouse=True)
def few_candidates(monkeypatch):
    monkeypatch.setattr(advice, "candidates", lambda _: [prdp.Chebyshev(1), prdp.CG(1), prdp.Direct(1)])


def advise(make, sample):
    device = StandIn()
    with device:
        return str(prdp.advise(make(device.send), device.send(sample), seconds=0.3, dtypes=()))


def test_it_times_there_and_says_so():
    def step(send):
        a = operators.Stencil(send(box(1)), FIVE, "zero")
        return prdp.ImplicitStep(a, solver=prdp.CG(1))

    text = advise(step, random(2, 1, 6, 7))
    assert "Batch of 2 in float64 on lazy:0." in text and "threads" not in text
    assert "Direct  " in text and "Direct was not" not in text
    assert "Chebyshev was not tried: the spectrum is known of Heat and Poisson" in text


def test_it_names_what_the_device_refuses():
    def step(send):
        c = box(1, (65, 64))
        c[0, 0] += random(65, 64).square()
        return prdp.ImplicitStep(operators.Stencil(send(c), FIVE, "zero"), solver=prdp.CG(1))

    text = advise(step, random(1, 1, 65, 64))
    assert "Direct was not tried: Direct on lazy:0 solves equations in 1D" in text and "Direct  " not in text


def test_the_clock_is_read_when_the_device_is_done(monkeypatch):
    called = []
    monkeypatch.setattr(torch.accelerator, "current_accelerator", lambda: torch.device("meta"))
    monkeypatch.setattr(torch.accelerator, "synchronize", called.append)
    solver_trials.now(torch.zeros(1))
    assert called == []
    solver_trials.now(torch.zeros(1, device="meta"))
    assert called == [torch.device("meta")]


def test_it_tries_solvers_in_kernels():
    step = prdp.Heat((6, 7), 0.1, 1.0, solver=prdp.CG(1))
    with Fibers():
        os.environ["PRDP_GPU"] = "auto"  # Direct has no kernel
        found = prdp.advise(step, random(2, 1, 6, 7), seconds=9.0, dtypes=())  # fibers are slow, and done before
    assert {type(row.solver) for row in found.rows if row.solved} == {prdp.Chebyshev, prdp.CG, prdp.Direct}


def test_the_clock_of_a_trial_leaves_compilation_out(monkeypatch):
    """Here the first run takes longer than all of them may, as it makes a kernel."""
    step, sample, run, made = prdp.Heat((6, 7), 0.1, 1.0, solver=prdp.CG(1)), random(2, 1, 6, 7), solver_trials.run, []

    def compile_and_run(*args):
        if not made:
            made.append("CG of Heat")
            time.sleep(0.4)
        return run(*args)

    monkeypatch.setattr(solver_trials._C, "kernels_made", lambda: list(made))
    monkeypatch.setattr(solver_trials, "run", compile_and_run)
    rows = solver_trials._measure_one(solver_trials.trial_of(step, sample), prdp.CG(1), 0.4)
    assert [row.rtol for row in rows] == list(solver_trials.TOLERANCES) and all(row.solved for row in rows)
    assert max(row.forward.seconds for row in rows) < 0.4
