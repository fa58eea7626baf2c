"""The scenes' networks. `MLP`, `ResNet` and `UNet` are twins of those in C++: same names, order and initialisation."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn import functional

from prdp_torch import _C as library
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


def _convolution(
    who: str, dim: int, before: int, after: int, kernel: int, periodic: bool = False
) -> torch.nn.Conv1d | torch.nn.Conv2d | torch.nn.Conv3d:
    """A convolution that keeps the extents of its input."""
    if dim not in (1, 2, 3):
        raise ValueError(f"{who}: dim must be 1, 2 or 3, got {dim}")
    kind = (torch.nn.Conv1d, torch.nn.Conv2d, torch.nn.Conv3d)[dim - 1]
    return kind(before, after, kernel, padding=kernel // 2, padding_mode="circular" if periodic else "zeros")


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

        def conv(before: int, after: int, kernel: int) -> torch.nn.Module:
            return _convolution("ResNet", dim, before, after, kernel, periodic and kernel > 1)

        self.lift = conv(channels, width, 1)
        self.blocks = torch.nn.ModuleList(
            torch.nn.Sequential(conv(width, width, 3), torch.nn.ReLU(), conv(width, width, 3)) for _ in range(blocks)
        )
        self.project = conv(width, channels, 1)

    def forward(self, u: Tensor) -> Tensor:
        x: Tensor = self.lift(u)
        for block in self.blocks:
            x = (x + block(x)).relu()
        projected: Tensor = self.project(x)
        return projected


class UNet(torch.nn.Module):
    """A U-net without normalisation. It maps a field (batch, channels, *shape) to one of the same shape; ValueError
    unless 2^levels divides each extent.

    A block is two convolutions with kernels of width three, a ReLU after each. On the way down there is a block on each
    of levels + 1 grids, each half as fine as the one before by means of 2^dim cells, with width, 2 width, 4 width, …
    channels. On the way up, each value is repeated into 2^dim cells, the output of the block of this grid on the way
    down is added as further channels, and a block follows. A pointwise convolution ends it.

    Args:
        dim: number of axes in shape: 1, 2 or 3, else ValueError.
        channels: of the field.
        levels: how often the grid is halved.
        width: channels of the blocks on the finest grid.
        periodic: whether the convolutions continue at the other end of the grid; otherwise they see zeros.

    Source: Ronneberger et al. 2015.
    """

    def __init__(self, dim: int, channels: int, levels: int, width: int, periodic: bool) -> None:
        super().__init__()

        def block(before: int, after: int) -> torch.nn.Sequential:
            first, second = (_convolution("UNet", dim, n, after, 3, periodic) for n in (before, after))
            return torch.nn.Sequential(first, torch.nn.ReLU(), second, torch.nn.ReLU())

        widths = [width * 2**level for level in range(levels + 1)]
        self.down = torch.nn.ModuleList(block(*pair) for pair in pairwise([channels, *widths]))
        self.up = torch.nn.ModuleList(block(fine + coarse, fine) for fine, coarse in reversed(list(pairwise(widths))))
        self.project = _convolution("UNet", dim, width, channels, 1)
        self._pool = (functional.avg_pool1d, functional.avg_pool2d, functional.avg_pool3d)[dim - 1]

    def forward(self, u: Tensor) -> Tensor:
        if any(extent % 2 ** len(self.up) for extent in u.shape[2:]):
            raise ValueError(f"UNet: expected extents that 2^{len(self.up)} divides, got {list(u.shape[2:])}")
        passed = []
        x: Tensor = self.down[0](u)
        for block in self.down[1:]:
            passed.append(x)
            x = block(self._pool(x, 2))
        for block in self.up:
            x = block(torch.cat([functional.interpolate(x, scale_factor=2.0), passed.pop()], 1))
        projected: Tensor = self.project(x)
        return projected


class Theta(torch.nn.Module):
    """θ, which a task without a network finds: κ = exp(θ) of a field, (*shape), or the load of a Poisson problem, a
    number for each of its modes. `train` gives it its start, and leaves in it what it has found."""

    def __init__(self, scene: _C.Scene) -> None:
        super().__init__()
        shape = scene.physics.shape if scene.task == "field" else _C.make_parameter_problem(scene).start.shape
        self.theta = torch.nn.Parameter(torch.zeros(shape, dtype=scene.dtype))

    def begin(self, start: Tensor) -> torch.nn.Parameter:
        """θ as a training begins with it, where it takes place."""
        self.theta = torch.nn.Parameter(start.clone())
        return self.theta


_KINDS: dict[str, Callable[[_C.Physics, _C.Network], torch.nn.Module]] = {
    "mlp": lambda physics, network: MLP(physics.channels * math.prod(physics.shape), network.hidden),
    "resnet": lambda physics, network: ResNet(
        len(physics.shape), physics.channels, network.blocks, network.width, physics.periodic
    ),
    "unet": lambda physics, network: UNet(
        len(physics.shape), physics.channels, network.levels, network.width, physics.periodic
    ),
}


def make_network(scene: _C.Scene, seed: int, without_memory: bool = False) -> torch.nn.Module:
    """Make the network of a scene, or the `Theta` of a task without one. The same seed gives the same weights in Python
    and in C++. `without_memory` makes it on the device "meta", for weights that are loaded into it; a class of the
    user's own is made as it is. ValueError for one whose training this machine cannot hold."""
    if not scene.trains_network:
        return Theta(scene)
    if scene.network.python:
        return own_networks.make(scene, seed)
    if not without_memory:
        _check_memory(scene, make_network(scene, seed, without_memory=True))
    physics, network = scene.physics, scene.network
    with torch.random.fork_rng(devices=[]), torch.device("meta" if without_memory else "cpu"):
        torch.manual_seed(seed)
        made = _KINDS[network.kind](physics, network)
        if network.zero_output:
            for parameter in list(made.parameters())[-2:]:  # weight and bias of the last layer
                torch.nn.init.zeros_(parameter)
        return made.to(scene.dtype)


def _check_memory(scene: _C.Scene, network: torch.nn.Module) -> None:
    """Before minutes go into initial weights, which would fill the memory."""
    count = sum(parameter.numel() for parameter in network.parameters())
    copies = 4 if scene.device.type == "cpu" else 1  # the gradient, and the two moments of Adam
    needed = copies * count * scene.dtype.itemsize
    if needed > library.physical_memory():
        raise ValueError(
            f"network: {count:,} weights would take {needed / 1e9:.3g} GB in the training, and this machine has "
            f"{library.physical_memory() / 1e9:.3g} GB"
        )
