"""Train an emulator with few, many and progressively more iterations: `python examples/first_emulator.py [EPOCHS]`
writes first_emulator.png. docs/first_emulator.md explains the program."""

import sys
from pathlib import Path

import torch

import prdp_torch as prdp
from prdp_torch.experiments.charts import make_figure, write_png

epochs = int(sys.argv[1]) if sys.argv[1:] else 100
torch.manual_seed(0)
x, n = torch.arange(1, 31) / 31, torch.arange(1, 6)[:, None]
waves = torch.cat([torch.sin(2 * torch.pi * n * x), torch.cos(2 * torch.pi * n * x)])
u0 = ((2 * torch.rand(100, 10) - 1) @ waves)[:, None]
exact = prdp.Heat(shape=(30,), nu=1e-3, dt=1.0, solver=prdp.Direct())
u2 = exact(exact(u0))


def train(k: int | None) -> tuple[list[float], list[int], list[float]]:
    """With K constant, or of PRDP for None: the iterations so far, K and the validation error of each epoch."""
    heat = prdp.Heat(shape=(30,), nu=1e-3, dt=1.0, solver=prdp.Jacobi(max_iter=1))
    controller: prdp.PRDPController | prdp.LinearSchedule = prdp.PRDPController([heat])
    if k is not None:
        controller = prdp.LinearSchedule([heat], initial=k, increment=0, maximum=k)
    torch.manual_seed(1)
    network = torch.nn.Sequential(
        torch.nn.Linear(30, 64), torch.nn.ReLU(), torch.nn.Linear(64, 64), torch.nn.ReLU(), torch.nn.Linear(64, 30)
    )
    optimiser = torch.optim.Adam(network.parameters(), lr=2e-3)
    spent, ks, errors = [0.0], [], []
    for _ in range(epochs):
        ks.append(heat.max_iter)
        spent.append(spent[-1] + 4 * heat.max_iter)
        for batch in torch.randperm(80).split(20):
            optimiser.zero_grad()
            torch.nn.functional.mse_loss(heat(network(u0[batch])), u2[batch]).backward()
            optimiser.step()
        with torch.no_grad():
            reached = network(network(u0[80:]))
        errors.append(float((reached - u2[80:]).square().mean() / u2[80:].square().mean()))
        controller.step(errors[-1])
    return spent[1:], ks, errors


figure, (left, right) = make_figure(panels=2, height=3.6)
for k, title, colour in ((25, "K = 25", "#222222"), (3, "K = 3", "#E69F00"), (None, "PRDP", "#d62728")):
    spent, ks, errors = train(k)
    print(f"{title}: error {errors[-1]:.3f}, {spent[-1]:.0f} iterations, last K {ks[-1]}")
    left.plot(spent, errors, color=colour, label=title)
    right.plot(ks, color=colour, label=title)
left.set(yscale="log", xlabel="iterations so far", ylabel="validation error", title="one seed")
right.set(xlabel="epoch", ylabel="K, iterations of a solve")
right.legend(frameon=False)
write_png(figure, Path("first_emulator.png"), dpi=100)
