"""`prdp.advise` beside a network of your own."""

import re
import time

import pytest
import torch
from helpers import field

import prdp_torch as prdp


class Slow(torch.nn.Module):
    """A network that takes some 30 ms, and counts its calls in a buffer."""

    def __init__(self):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.ones(()))
        self.register_buffer("calls", torch.zeros(()))

    def forward(self, u):
        self.calls += 1
        time.sleep(0.03)
        return self.scale * u


def test_a_network_of_your_own_counts_as_a_part_of_an_update():
    step = prdp.Heat((8,), nu=1e-2, dt=1.0, solver=prdp.Jacobi(1))
    network = Slow()
    text = prdp.advise(step, field((8,), batch=2), seconds=1.0, network=network).recommendation
    found = re.search(r"physics is ([\d.]+)% of an update: ([\d.]+) ms of ([\d.]+) ms", text)
    share, physics, whole = map(float, found.groups())
    assert share < 50 and 30 < whole < 300 and share == pytest.approx(100 * physics / whole, rel=0.1, abs=0.6)
    assert network.calls == 0 and network.scale.grad is None


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (lambda u: u, "network must be a torch.nn.Module, got function"),
        (torch.nn.ReLU(), "network has no parameter that requires grad"),
        (torch.nn.LSTM(8, 8), r"network\(sample\) must be a tensor that depends on the parameters"),
    ],
)
def test_a_network_that_cannot_be_trained_is_refused(network, message):
    step = prdp.Heat((8,), nu=1e-2, dt=1.0, solver=prdp.Jacobi(1))
    with pytest.raises((TypeError, ValueError), match=f"advise: {message}"):
        prdp.advise(step, torch.randn(2, 1, 8), seconds=1.0, network=network)
