"""The scenes' networks. `MLP` and `ResNet` are twins of those in C++: same names, order and initialisation."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from prdp_torch.experiments import _C, own_networks


class MLP(torch.nn.Module):
    """A multilayer perceptron with ReLU between its layers. It maps a field (batch, channels, *shape) to one of the
    same shape.

    Args:
        unknowns: channels times the number of grid points, the width of the first and the last layer.
        hidden: widths of the layers between.
    """

    def __init__(self, unknowns: int, hidden: Sequence[int]) -> None:
        super().__init__()
        widths = [unknowns, *hidden, unknowns]
        self.layers = torch.nn.ModuleList(torch.nn.Linear(before, after) for before, after in pairwise(widths))

    def forward(self, u: Tensor) -> Tensor:
        x = u.flatten(1)
        for i, layer in enumerate(self.layers):
            x = layer(x.relu() if i > 0 else x)
        return x.view(u.shape)


class ResNet(torch.nn.Module):
    """A residual convolution network without normalisation. It maps a field (batch, channels, *shape) on any grid to
    one of the same shape.

    A pointwise convolution lifts the channels to `width`. Each of the `blocks` computes
    x ← relu(x + conv(relu(conv(x)))) with kernels of width three. A pointwise convolution projects back.

    Args:
        dim: number of axes in shape: 1, 2 or 3, else ValueError.
        channels: of the field.
        blocks: number of residual blocks.
        width: channels of the blocks.
        periodic: whether the convolutions continue at the other end of the grid; otherwise they see zeros.

    Source: He et al. 2016.
    """

    def __init__(self, dim: int, channels: int, blocks: int, width: int, periodic: bool) -> None:
        super().__init__()
        if dim not in (1, 2, 3):
            raise ValueError(f"ResNet: dim must be 1, 2 or 3, got {dim}")
        conv = (torch.nn.Conv1d, torch.nn.Conv2d, torch.nn.Conv3d)[dim - 1]
        three_wide: dict[str, Any] = {
            "kernel_size": 3,
            "padding": 1,
            "padding_mode": "circular" if periodic else "zeros",
        }
        self.lift = conv(channels, width, 1)
        self.blocks = torch.nn.ModuleList(
            torch.nn.Sequential(conv(width, width, **three_wide), torch.nn.ReLU(), conv(width, width, **three_wide))
            for _ in range(blocks)
        )
        self.project = conv(width, channels, 1)

    def forward(self, u: Tensor) -> Tensor:
        x: Tensor = self.lift(u)
        for block in self.blocks:
            x = (x + block(x)).relu()
        projected: Tensor = self.project(x)
        return projected


_KINDS: dict[str, Callable[[_C.Physics, _C.Network], torch.nn.Module]] = {
    "mlp": lambda physics, network: MLP(physics.channels * math.prod(physics.shape), network.hidden),
    "resnet": lambda physics, network: ResNet(
        len(physics.shape), physics.channels, network.blocks, network.width, physics.periodic
    ),
}


def make_network(scene: _C.Scene, seed: int, without_memory: bool = False) -> torch.nn.Module:
    """Make the network of a scene. The same seed gives the same weights in Python and in C++. `without_memory` makes
    it on the device "meta", for weights that are loaded into it; a class of the user's own is made as it is."""
    if scene.network.python:
        return own_networks.make(scene, seed)
    physics, network = scene.physics, scene.network
    with torch.random.fork_rng(devices=[]), torch.device("meta" if without_memory else "cpu"):
        torch.manual_seed(seed)
        made = _KINDS[network.kind](physics, network)
        if network.zero_output:
            for parameter in list(made.parameters())[-2:]:  # weight and bias of the last layer
                torch.nn.init.zeros_(parameter)
        return made.to(scene.dtype)
