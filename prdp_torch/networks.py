"""The scenes' networks, twins of those in C++: same parameter names, order and initialisation."""

import math
from itertools import pairwise

import torch


class MLP(torch.nn.Module):
    """Multilayer perceptron with ReLU between its layers, from a field (batch, channels, *shape) to
    one of the same shape: unknowns → hidden[0] → … → unknowns."""

    def __init__(self, unknowns, hidden):
        super().__init__()
        widths = [unknowns, *hidden, unknowns]
        self.layers = torch.nn.ModuleList(torch.nn.Linear(before, after) for before, after in pairwise(widths))

    def forward(self, u):
        x = u.flatten(1)
        for i, layer in enumerate(self.layers):
            x = layer(x.relu() if i > 0 else x)
        return x.view(u.shape)


class ResNet(torch.nn.Module):
    """Residual network (He et al. 2016, without normalisation) from a field (batch, channels, *shape) of
    any extents to one of the same shape: a convolution lifts channels → width point by point, `blocks`
    times x ← relu(x + conv(relu(conv(x)))) with three-wide kernels, and a last convolution projects
    width → channels point by point. Beyond the grid the blocks see the other end of the field where it
    is periodic, else zeros. `dim` axes in `shape`; ValueError unless 1, 2 or 3."""

    def __init__(self, dim, channels, blocks, width, periodic):
        super().__init__()
        if dim not in (1, 2, 3):
            raise ValueError(f"ResNet: dim must be 1, 2 or 3, got {dim}")
        conv = (torch.nn.Conv1d, torch.nn.Conv2d, torch.nn.Conv3d)[dim - 1]
        three_wide = {"kernel_size": 3, "padding": 1, "padding_mode": "circular" if periodic else "zeros"}
        self.lift = conv(channels, width, 1)
        self.blocks = torch.nn.ModuleList(
            torch.nn.Sequential(conv(width, width, **three_wide), torch.nn.ReLU(), conv(width, width, **three_wide))
            for _ in range(blocks)
        )
        self.project = conv(width, channels, 1)

    def forward(self, u):
        x = self.lift(u)
        for block in self.blocks:
            x = (x + block(x)).relu()
        return self.project(x)


def make_network(scene, seed):
    """The scene's network with the weights that belong to the seed, in every language."""
    physics, network = scene.physics, scene.network
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if network.kind == "mlp":
            made = MLP(physics.channels * math.prod(physics.shape), network.hidden)
        else:
            made = ResNet(len(physics.shape), physics.channels, network.blocks, network.width, physics.periodic)
        if network.zero_output:
            for parameter in list(made.parameters())[-2:]:  # weight and bias of the last layer
                torch.nn.init.zeros_(parameter)
        return made.to(scene.dtype)
