"""The scenes' networks: shapes, boundaries, sizes, and that a seed determines them."""

import time

import numpy as np
import pytest
import torch
from helpers import written

from prdp_torch.experiments import scenes
from prdp_torch.experiments.networks import MLP, ResNet, UNet, make_network

SHAPES = [(13,), (7, 9), (5, 6, 7)]


def resnet(shape, periodic, channels=1, blocks=2, width=4):
    torch.manual_seed(0)
    return ResNet(len(shape), channels, blocks, width, periodic).double()


def unet(shape, periodic, channels=1, levels=2, width=3):
    torch.manual_seed(0)
    return UNet(len(shape), channels, levels, width, periodic).double()


def described(network, periodic):
    """The convolutions of a network in numpy, by name: every tap of a kernel is a shift of the padded field."""
    weights = {name: p.detach().numpy() for name, p in network.named_parameters()}

    def conv(x, name):
        weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
        shape, reach = x.shape[1:], weight.shape[2] // 2
        padded = np.pad(x, [(0, 0)] + [(reach, reach)] * len(shape), mode="wrap" if periodic else "constant")
        out = np.zeros((len(weight), *shape))
        for tap in np.ndindex(*weight.shape[2:]):
            window = padded[(slice(None), *(slice(k, k + n) for k, n in zip(tap, shape, strict=True)))]
            out += np.tensordot(weight[(slice(None), slice(None), *tap)], window, axes=1)
        return out + bias.reshape(-1, *[1] * len(shape))

    return conv, list(weights)


def test_the_perceptron_keeps_the_shape_and_has_the_papers_size():
    network = make_network(scenes.load("heat_1d"), 0)
    assert sum(p.numel() for p in network.parameters()) == 12254
    assert [n for n, _ in network.named_parameters()][:2] == ["layers.0.weight", "layers.0.bias"]
    assert MLP(12, [5])(torch.zeros(2, 1, 3, 4)).shape == (2, 1, 3, 4)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("periodic", [True, False])
@pytest.mark.parametrize("batch, channels", [(1, 1), (3, 2)])
def test_a_resnet_keeps_the_shape_and_every_value_matters(shape, periodic, batch, channels):
    network = resnet(shape, periodic, channels)
    u = torch.randn(batch, channels, *shape, dtype=torch.float64, requires_grad=True)
    out = network(u)
    assert out.shape == u.shape
    out.square().sum().backward()
    assert (u.grad != 0).all() and all((p.grad != 0).any() for p in network.parameters())


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shift_commutes_with_a_periodic_resnet_alone(shape):
    u = torch.randn(2, 1, *shape, dtype=torch.float64)
    periodic, zeros = resnet(shape, True), resnet(shape, False)
    for axis in range(2, u.dim()):
        for by in (1, 3, -2):
            torch.testing.assert_close(periodic(u.roll(by, axis)), periodic(u).roll(by, axis), rtol=1e-10, atol=1e-12)
        assert not torch.allclose(zeros(u.roll(1, axis)), zeros(u).roll(1, axis), atol=1e-3)


@pytest.mark.parametrize("shape", [(40,), (24, 26)])
@pytest.mark.parametrize("periodic", [True, False])
def test_what_happens_at_one_end_is_seen_at_the_other_where_it_is_periodic(shape, periodic):
    """Two blocks look four points far."""
    network = resnet(shape, periodic)
    u = torch.randn(1, 1, *shape, dtype=torch.float64)
    changed = u.clone()
    changed.select(-1, 0).add_(1.0)
    seen = (network(changed) != network(u)).any(dim=-2) if len(shape) == 2 else network(changed) != network(u)
    seen = seen.flatten()
    assert seen[0] and not seen[5:-4].any()
    assert seen[-4:].any() == periodic


@pytest.mark.parametrize("shape", [(11,), (5, 6), (4, 5, 3)])
@pytest.mark.parametrize("periodic", [True, False])
def test_a_resnet_is_what_its_description_says(shape, periodic):
    network = resnet(shape, periodic, channels=2, blocks=2, width=3)
    conv, names = described(network, periodic)
    assert names[:6] == [
        "lift.weight", "lift.bias", "blocks.0.0.weight", "blocks.0.0.bias", "blocks.0.2.weight", "blocks.0.2.bias",
    ]  # fmt: skip
    u = np.random.default_rng(0).standard_normal((2, *shape))
    x = conv(u, "lift")
    for i in range(2):
        x = np.maximum(x + conv(np.maximum(conv(x, f"blocks.{i}.0"), 0), f"blocks.{i}.2"), 0)
    np.testing.assert_allclose(network(torch.from_numpy(u)[None])[0].detach(), conv(x, "project"), rtol=1e-12)


@pytest.mark.parametrize(
    "dim, channels, blocks, width", [(1, 1, 6, 32), (2, 3, 3, 64), (3, 1, 6, 32)], ids=["burgers", "ns", "heat3d"]
)
def test_a_resnet_has_as_many_parameters_as_its_kernels_say(dim, channels, blocks, width):
    convolution = width * width * 3**dim + width
    expected = (channels * width + width) + 2 * blocks * convolution + (width * channels + channels)
    assert sum(p.numel() for p in ResNet(dim, channels, blocks, width, True).parameters()) == expected


@pytest.mark.parametrize("kind", [ResNet, UNet])
def test_a_network_has_at_most_three_axes(kind):
    with pytest.raises(ValueError, match=f"{kind.__name__}: dim must be 1, 2 or 3, got 4"):
        kind(4, 1, 1, 8, True)


@pytest.mark.parametrize("shape", [(12,), (8, 4), (4, 8, 4)])
@pytest.mark.parametrize("periodic", [True, False])
def test_a_unet_is_what_its_description_says(shape, periodic):
    network = unet(shape, periodic, channels=2)
    conv, names = described(network, periodic)
    blocks = [f"{way}.{i}.{j}" for way, count in (("down", 3), ("up", 2)) for i in range(count) for j in (0, 2)]
    assert names == [f"{layer}.{kind}" for layer in (*blocks, "project") for kind in ("weight", "bias")]

    def block(x, name):
        return np.maximum(conv(np.maximum(conv(x, f"{name}.0"), 0), f"{name}.2"), 0)

    def halved(x):
        for axis in range(1, x.ndim):
            pairs = x.reshape(*x.shape[:axis], -1, 2, *x.shape[axis + 1 :])
            x = pairs.mean(axis + 1)
        return x

    def doubled(x):
        for axis in range(1, x.ndim):
            x = x.repeat(2, axis)
        return x

    u = np.random.default_rng(0).standard_normal((2, *shape))
    fine = block(u, "down.0")
    middle = block(halved(fine), "down.1")
    coarse = block(halved(middle), "down.2")
    middle = block(np.concatenate([doubled(coarse), middle]), "up.0")
    fine = block(np.concatenate([doubled(middle), fine]), "up.1")
    np.testing.assert_allclose(network(torch.from_numpy(u)[None])[0].detach(), conv(fine, "project"), rtol=1e-12)


def test_a_shift_by_coarse_cells_commutes_with_a_periodic_unet_alone():
    u = torch.randn(2, 1, 16, 12, dtype=torch.float64)
    periodic, zeros = unet((16, 12), True), unet((16, 12), False)
    for axis in (2, 3):
        torch.testing.assert_close(periodic(u.roll(4, axis)), periodic(u).roll(4, axis), rtol=1e-10, atol=1e-12)
        assert not torch.allclose(zeros(u.roll(4, axis)), zeros(u).roll(4, axis), atol=1e-3)


def test_a_unet_refuses_a_grid_that_it_cannot_halve():
    with pytest.raises(ValueError, match=r"UNet: expected extents that 2\^2 divides, got \[8, 6\]"):
        unet((8, 8), True)(torch.zeros(1, 1, 8, 6, dtype=torch.float64))


def test_the_scenes_networks_see_beyond_the_grid_what_the_equation_sees():
    """Zeros around a Dirichlet grid, the other end of a periodic one; sizes as the paper has them."""
    for name, modes, parameters in (("heat_3d", "zeros", 332257), ("burgers_1d", "circular", 37345)):
        network = make_network(scenes.load(name), 0)
        kernels = [module for module in network.blocks.modules() if hasattr(module, "padding_mode")]
        assert {kernel.padding_mode for kernel in kernels} == {modes}
        assert sum(p.numel() for p in network.parameters()) == parameters
    assert sum(p.numel() for p in make_network(scenes.load("heat_2d"), 0).parameters()) == 23409900


def test_a_network_may_start_from_zero_output():
    scene = scenes.load("burgers_2d")
    network, u = make_network(scene, 0), torch.randn(2, 2, 96, 96)
    assert scene.network.zero_output and (network(u) == 0).all()
    assert all(p.abs().max() > 0 for p in list(network.parameters())[:-2])
    assert not (make_network(scenes.load("heat_1d"), 0)(torch.randn(2, 1, 30)) == 0).any()


@pytest.mark.parametrize("name", ["heat_1d", "burgers_1d"])
def test_weights_depend_on_the_seed_alone(name):
    scene = scenes.load(name)
    torch.manual_seed(123)
    before = torch.get_rng_state()
    first, again, other = make_network(scene, 0), make_network(scene, 0), make_network(scene, 1)
    assert torch.equal(torch.get_rng_state(), before)
    for p, q, r in zip(first.parameters(), again.parameters(), other.parameters(), strict=True):
        assert torch.equal(p, q) and not torch.equal(p, r)
    u = torch.zeros(2, scene.physics.channels, *scene.physics.shape)
    assert first(u).shape == u.shape


def test_a_network_that_the_machine_cannot_hold_is_refused_before_it_is_made(tmp_path):
    scene = scenes.load(written(tmp_path, ("shape = [30]", "shape = [1000000000]")))
    started = time.perf_counter()
    with pytest.raises(ValueError, match=r"network: 129,000,008,384 weights would take 2\.06e\+03 GB in the training"):
        make_network(scene, 0)
    assert time.perf_counter() - started < 5
