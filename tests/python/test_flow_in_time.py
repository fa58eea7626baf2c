"""The order of `Flow` in the time step, and of the mean of two steps (Heun's method), which the pages give."""

import pytest
import torch
from flows import random_velocity

import prdp_torch as prdp


class Heun(prdp.Flow):
    def forward(self, u):
        return (u + super().forward(super().forward(u))) / 2


def settings(name):
    if name == "periodic":
        return {"nu": 5e-3}
    if name == "cavity":
        return {"nu": 1e-2, "boundary": "wall", "wall_velocity": {(0, "high"): 1.0}}
    return {"nu": 1e-2, "boundary": ("slip", "open"), "inflow": (0.5, 0.0)}


def smooth(n):
    """A velocity of the first few waves, with a largest component of one."""
    u = random_velocity((n, n))
    waves = torch.fft.fftfreq(n, 1 / n, dtype=torch.float64)
    u = torch.fft.ifft2(torch.fft.fft2(u) * torch.exp(-(waves[:, None] ** 2 + waves**2) / 4)).real
    return u / u.abs().max()


def after(kind, name, u, steps, final=0.4, diffusion="explicit"):
    flow = kind((16, 16), dt=final / steps, diffusion=diffusion, solver=prdp.Direct(), **settings(name))
    return flow.rollout(flow.project(u), steps)[:, -1]


@pytest.mark.parametrize("name", ["periodic", "cavity", "channel"])
def test_a_step_is_first_order_and_the_mean_of_two_second(name):
    u = smooth(16)
    exact = after(Heun, name, u, 1600)
    for kind, factor in ((prdp.Flow, 2.0), (Heun, 4.0)):
        errors = [(after(kind, name, u, steps) - exact).norm() / exact.norm() for steps in (50, 100)]
        assert errors[0] / errors[1] == pytest.approx(factor, rel=0.1), (kind, errors)
    assert errors[1] < 1e-4


def test_implicit_diffusion_stays_first_order():
    u = smooth(16)
    exact = after(Heun, "periodic", u, 1600)
    errors = [(after(Heun, "periodic", u, steps, diffusion="implicit") - exact).norm() for steps in (50, 100)]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def test_its_rollout_and_its_gradient_are_those_of_its_steps():
    flow = Heun((16, 16), dt=1e-2, diffusion="explicit", solver=prdp.Direct(), **settings("periodic"))
    u = smooth(16).requires_grad_()
    states = flow.rollout(u, 3)
    assert torch.equal(states[:, -1], flow(flow(flow(u))))
    direction, h = smooth(16).flip(-1), 1e-6
    (grad,) = torch.autograd.grad(states[:, -1].square().sum(), u)
    with torch.no_grad():
        ends = [flow.rollout(u + sign * h * direction, 3)[:, -1].square().sum() for sign in (1, -1)]
    torch.testing.assert_close((grad * direction).sum(), (ends[0] - ends[1]) / (2 * h), rtol=1e-7, atol=0)
