"""Train an emulator on a file in PDEBench's layout: `python examples/pdebench_data.py [EPOCHS]`.

It makes a small file first, as a stand-in for a download, and writes pdebench_data.png."""

import re
import sys
from pathlib import Path

import h5py
import numpy as np
import torch

import prdp_torch as prdp
from prdp_torch.experiments import pdebench, scenes, training
from prdp_torch.experiments.charts import make_figure, write_png
from prdp_torch.experiments.refinement import Refinement

epochs = int(sys.argv[1]) if sys.argv[1:] else 60

# The file: 310 solutions of u_t = 1e-3 u_xx on 30 points, exact, with u = 0 at both ends.
x, t, k = np.arange(1, 31) / 31, np.arange(0.0, 6.0), np.arange(1, 7)
amplitudes = np.random.default_rng(0).normal(size=(310, 1, 6)) / k
decay = np.exp(-1e-3 * (np.pi * k) ** 2 * t[:, None])
with h5py.File("heat.hdf5", "w") as file:
    file["tensor"] = (amplitudes * decay) @ np.sin(np.pi * np.outer(k, x))  # (samples, times, x)
    file["x-coordinate"], file["t-coordinate"] = x, t

# The scene: that of the paper, with the file for its data. dt, nu and the grid are those of the file.
text = scenes.available()["heat_1d"].read_text()
data = '[data]\nfile = "heat.hdf5"\ntrain = 300\nvalid = 10\nvalid_steps = 5\n'
Path("heat_file.toml").write_text(re.sub(r"\[data\]\n.*?\n(?=\n\[)", data, text, flags=re.DOTALL))
scene = scenes.load("heat_file.toml")
scene.training.intervals = epochs

torch.manual_seed(0)
network = torch.nn.Sequential(torch.nn.Linear(30, 128), torch.nn.ReLU(), torch.nn.Linear(128, 30))
curves = training.train(scene, Refinement.auto(), network=network)
states = pdebench.read("heat.hdf5", scene)[300:]
with torch.no_grad():
    reached = prdp.fields.rollout(network, states[:, 0], 5)
error = (reached[:, 5] - states[:, 5]).norm() / states[:, 5].norm()
products = sum(curves["operator_applications"])
print(f"error after 5 steps {error:.3f}, with {products:,.0f} products with A for each sample")

figure, (left, right) = make_figure(panels=2, height=3.6)
left.plot(curves["metric"], color="#0072B2")
left.set(yscale="log", xlabel="epoch", ylabel="(‖u − u_ref‖ / ‖u_ref‖)² after 5 steps", title="one seed")
for step, colour in ((0, "#999999"), (2, "#E69F00"), (5, "#0072B2")):
    right.plot(x, states[0, step, 0], color=colour, label=f"t = {step}")
    right.plot(x, reached[0, step, 0], ".", color=colour)
right.set(xlabel="x", title="a validation sample: file (lines), network (dots)")
right.legend(frameon=False)
write_png(figure, Path("pdebench_data.png"), dpi=100)
