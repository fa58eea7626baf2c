"""Ctrl-C in a rollout of an own equation: KeyboardInterrupt and nothing else, wherever it comes."""

import signal
import sys
import time

import pytest
import torch

import prdp_torch as prdp


def test_an_interruption_anywhere_in_a_rollout_is_never_ignored(monkeypatch, no_callbacks_of_the_collector):
    step = prdp.ImplicitStep(torch.eye(3), solver=prdp.CG(1))
    u = torch.ones(2, 3)
    unraisable, interrupted = [], 0
    monkeypatch.setattr(sys, "unraisablehook", unraisable.append)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        for number in range(400):
            try:
                signal.setitimer(signal.ITIMER_REAL, 1e-4 + 1e-5 * number)
                until = time.monotonic() + 10
                while time.monotonic() < until:
                    step.rollout(u, 50)
            except KeyboardInterrupt:
                interrupted += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert interrupted == 400 and not unraisable, unraisable[:3]


def test_a_log_that_could_not_be_opened_is_not_closed(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    unraisable = []
    monkeypatch.setattr(sys, "unraisablehook", unraisable.append)
    name = "AdjointLog" if hasattr(prdp.solve._C, "AdjointLog") else "open_adjoint_log"
    monkeypatch.setattr(prdp.solve._C, name, interrupted)
    with pytest.raises(KeyboardInterrupt):
        prdp.solve.AdjointLog()
    assert not unraisable
