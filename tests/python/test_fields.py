"""Velocity fields on the staggered grid, against closed forms."""

import math

import pytest
import torch
from helpers import field

import prdp_torch as prdp
from prdp_torch import fields


@pytest.mark.parametrize("channels", [2, 3])
@pytest.mark.parametrize("shape", [(4, 4), (5, 8), (9, 6)])
def test_divergence_and_curl_are_the_differences_between_faces(channels, shape):
    u = field(shape, channels=channels)
    ny, nx = shape
    divergence, curl = fields.divergence(u), fields.curl(u)
    assert divergence.shape == curl.shape == (2, 1, *shape)
    for j in range(ny):
        for i in range(nx):
            right, above = u[:, 0, j, (i + 1) % nx], u[:, 1, (j + 1) % ny, i]
            expected = (right - u[:, 0, j, i]) * nx + (above - u[:, 1, j, i]) * ny
            torch.testing.assert_close(divergence[:, 0, j, i], expected)
            expected = (u[:, 1, j, i] - u[:, 1, j, i - 1]) * nx - (u[:, 0, j, i] - u[:, 0, j - 1, i]) * ny
            torch.testing.assert_close(curl[:, 0, j, i], expected)


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-12), (torch.float32, 1e-4)])
@pytest.mark.parametrize("shape", [(8, 8), (5, 8), (7, 6), (33, 17)])
def test_project_takes_off_the_gradient_part_alone(dtype, bound, shape):
    u = field(shape, channels=3).to(dtype)
    v = fields.project(u)
    assert v.dtype == dtype and torch.equal(v[:, 2], u[:, 2])
    assert fields.divergence(v).abs().max() < bound * max(shape)
    torch.testing.assert_close(fields.project(v), v, rtol=0, atol=bound)
    torch.testing.assert_close(fields.curl(v), fields.curl(u), rtol=0, atol=10 * bound * max(shape))
    torch.testing.assert_close(v.mean((2, 3)), u.mean((2, 3)), rtol=0, atol=bound)
    # Nearest: what was taken off is orthogonal to what stays.
    assert ((u - v) * v).sum((1, 2, 3)).abs().max() < 1e2 * bound


def test_sides_of_unequal_length_are_those_of_the_derivatives():
    """Of u = (sin kx, cos ly) and its like, up to the error of a difference, dx² / 24 of the third derivative."""
    (ly, lx), (ny, nx) = (0.5, 3.0), (64, 96)
    y, x = torch.arange(ny, dtype=torch.float64)[:, None] * ly / ny, torch.arange(nx, dtype=torch.float64) * lx / nx
    dy, dx, k, m = ly / ny, lx / nx, 2 * math.pi / lx, 4 * math.pi / ly
    bound = 1.01 * (k**3 * dx**2 + m**3 * dy**2) / 24
    along = torch.stack([torch.sin(k * x).expand(ny, nx), torch.cos(m * y).expand(ny, nx)])[None]
    expected = k * torch.cos(k * (x + dx / 2)) - m * torch.sin(m * (y + dy / 2))
    assert (fields.divergence(along, (ly, lx)) - expected).abs().max() < bound
    across = along.flip(1)
    expected = k * torch.cos(k * (x - dx / 2)) + m * torch.sin(m * (y - dy / 2))
    assert (fields.curl(across, (ly, lx)) - expected).abs().max() < bound
    # A velocity that flows through no cell stays as it is; a gradient goes as a whole.
    v = fields.project(field((ny, nx), channels=2), (ly, lx))
    assert fields.divergence(v, (ly, lx)).abs().max() < 1e-10
    torch.testing.assert_close(fields.project(along, (ly, lx)), torch.zeros_like(along), rtol=0, atol=1e-12)
    torch.testing.assert_close(fields.project(across, (ly, lx)), across, rtol=0, atol=1e-12)


def test_fields_differentiate():
    u = field((3, 4), channels=2).requires_grad_()
    for f in (fields.divergence, fields.curl, fields.project):
        assert torch.autograd.gradcheck(f, u)


def test_downsample_takes_every_second_point():
    u = torch.arange(2 * 97 * 97.0).view(1, 2, 97, 97)
    v = fields.downsample(u)
    assert v.shape == (1, 2, 48, 48)
    assert torch.equal(v[0, 1], u[0, 1, range(1, 96, 2)][:, range(1, 96, 2)])
    assert fields.downsample(field((5, 7), channels=3)).shape == (2, 3, 2, 3)


def test_rollout_stacks_the_states_and_differentiates():
    step = prdp.Burgers((9,), 1e-2, 0.1, solver=prdp.Direct())
    u = field((9,)).requires_grad_()
    states = fields.rollout(step, u, 3)
    assert states.shape == (2, 4, 1, 9)
    assert torch.equal(states[:, 0], u) and torch.equal(states[:, 3], step(step(step(u))))
    expected = torch.autograd.grad(step(step(step(u))).sum(), u)[0]
    torch.testing.assert_close(torch.autograd.grad(states[:, 3].sum(), u)[0], expected)
    assert torch.equal(fields.rollout(math.sin, u, 0), u[:, None])


@pytest.mark.parametrize(
    "call, error, message",
    [
        (lambda: fields.divergence(field((4, 4))), ValueError,
         r"divergence: expected \(batch, 2 or 3, Ny, Nx\), got \(2, 1, 4, 4\)"),
        (lambda: fields.project(torch.zeros(2, 4, 4)), ValueError, r"project: expected .* got \(2, 4, 4\)"),
        (lambda: fields.curl(torch.zeros(1, 2, 4, 4, dtype=torch.int64)), TypeError, "curl: expected float32 or"),
        (lambda: fields.downsample(torch.zeros(1, 2, 97, 96)), ValueError,
         r"downsample: Ny and Nx must be odd, got \(97, 96\)"),
        (lambda: fields.downsample([0.0]), TypeError, "downsample: u must be a torch tensor, got list"),
        (lambda: fields.rollout(math.sin, field((4,)), -1), ValueError, "rollout: steps must be >= 0, got -1"),
        (lambda: fields.rollout(math.sin, field((4,)), 1.5), TypeError, "rollout: steps must be a whole number"),
        (lambda: fields.rollout(lambda u: u[..., 1:], field((4,)), 2), ValueError,
         r"rollout: the step must keep the shape of its input, \(2, 1, 4\), got \(2, 1, 3\)"),
    ],
)  # fmt: skip
def test_bad_arguments_are_refused_in_words(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_rollout_refuses_a_step_that_changes_its_state():
    """As the states before it would be other ones than those that were handed out."""
    network = torch.nn.Sequential(torch.nn.ReLU(inplace=True), torch.nn.Linear(8, 8))
    with torch.no_grad(), pytest.raises(ValueError, match="rollout: the step changes its state in place"):
        fields.rollout(network, torch.randn(2, 1, 8), 1)
    history = torch.zeros(2, 4, 8)
    assert fields.rollout(lambda u: history[:, 1:2].copy_(u + 1), history[:, :1], 1).shape == (2, 2, 1, 8)
