"""Steppers that threads share, and steppers whose calls are interrupted: neither leaves a trace in the other calls."""

import contextvars
import random
import signal
import threading
import time

import pytest
import torch

import prdp_torch as prdp


class OwnForward(prdp.Heat):
    def forward(self, u):
        return super().forward(u) + 0


def heat(kind=prdp.Heat):
    return kind((20, 20), 1e-2, 1.0, solver=prdp.CG(50))


def with_hook(step):
    step.register_forward_hook(lambda *_: None)
    return step


MAKE = {
    "hook": lambda: with_hook(heat()),
    "own forward": lambda: heat(OwnForward),
    "implicit step": lambda: with_hook(prdp.ImplicitStep(prdp.operators.Heat((20, 20), 1e-2, 1.0), solver=prdp.CG(50))),
    "flow": lambda: with_hook(prdp.Flow((16, 16), nu=1e-3, dt=1e-3)),
}


def start_of(name):
    shape = (2, 2, 16, 16) if name == "flow" else (2, 1, 20, 20)
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("name", MAKE)
def test_threads_share_rollouts_that_repeat_calls(name):
    step, u = MAKE[name](), start_of(name)
    expected = step.rollout(u, 5)
    lone = u.clone().requires_grad_()
    step.rollout(lone, 5).sum().backward()
    iterations = step.adjoint_info.iterations
    wrong = []

    def loop():
        try:
            for _ in range(15):
                mine = u.clone().requires_grad_()
                states = step.rollout(mine, 5)
                states.sum().backward()
                wrong.extend([] if torch.equal(states, expected) and torch.equal(mine.grad, lone.grad) else ["bits"])
        except Exception as error:
            wrong.append(error)

    threads = [threading.Thread(target=loop) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    step.rollout(lone, 5).sum().backward()
    assert torch.equal(step.adjoint_info.iterations, iterations) and step.info.iterations.shape == (2, 5)


def interrupts(call, seconds, longest):
    """Call it until it is interrupted, again and again; after a second where Python dropped that. Yields each time."""
    handler = signal.signal(signal.SIGALRM, signal.default_int_handler)
    generator, end = random.Random(0), time.monotonic() + seconds
    try:
        while time.monotonic() < end:
            try:
                signal.setitimer(signal.ITIMER_REAL, generator.uniform(1e-4, longest))
                until = time.monotonic() + 1
                while time.monotonic() < until:
                    call()
            except KeyboardInterrupt:
                signal.setitimer(signal.ITIMER_REAL, 0)
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)


def test_an_interrupted_rollout_can_be_made_again(no_callbacks_of_the_collector):
    step, u = with_hook(prdp.Heat((8, 8), 1e-2, 1.0, solver=prdp.CG(50))), torch.rand(1, 1, 8, 8)
    expected = step.rollout(u, 2)
    for _ in interrupts(lambda: step.rollout(u, 20), seconds=3, longest=0.005):
        assert torch.equal(step.rollout(u, 2), expected)


@pytest.mark.parametrize("as_parameter", [True, False], ids=["parameter", "number"])
def test_an_interrupt_leaves_the_old_nu_or_the_new_one(as_parameter, no_callbacks_of_the_collector):
    nu = torch.nn.Parameter if as_parameter else float
    step, u = prdp.Heat((16,), nu(torch.tensor(0.1)), 1.0, solver=prdp.CG(50)), torch.rand(1, 1, 16)

    def change():
        step.nu = nu(torch.rand(()))

    for _ in interrupts(change, seconds=2, longest=0.003):
        assert 0 <= float(torch.as_tensor(step.nu).detach()) <= 1 and step(u).isfinite().all()
        assert len(list(step.parameters())) == as_parameter


def test_a_user_of_context_variables_keeps_them_in_a_rollout():
    count = contextvars.ContextVar("count", default=0)

    class Counting(prdp.Heat):
        def forward(self, u):
            count.set(count.get() + 1)
            return super().forward(u)

    Counting((8,), 0.1, 0.1, prdp.CG(9)).rollout(torch.rand(1, 1, 8), 3)
    assert count.get() == 3
