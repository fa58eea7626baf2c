"""The scenes' networks, twins of those in C++: same parameter names, order and initialisation."""

from itertools import pairwise

import torch


class MLP(torch.nn.Module):
    """Multilayer perceptron with ReLU between its layers, from a field (batch, 1, *shape) to one of
    the same shape: unknowns → hidden[0] → … → unknowns."""

    def __init__(self, unknowns, hidden):
        super().__init__()
        widths = [unknowns, *hidden, unknowns]
        self.layers = torch.nn.ModuleList(torch.nn.Linear(before, after) for before, after in pairwise(widths))

    def forward(self, u):
        x = u.flatten(1)
        for i, layer in enumerate(self.layers):
            x = layer(x.relu() if i > 0 else x)
        return x.view(u.shape)


def make_network(scene, seed):
    """The scene's network with the weights that belong to the seed, in every language."""
    unknowns = 1
    for n in scene.physics.shape:
        unknowns *= n
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MLP(unknowns, scene.network.hidden).to(scene.dtype)
