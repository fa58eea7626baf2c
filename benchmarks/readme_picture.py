"""The picture of the README: a field that is found, and what it and a network cost with three ways of solving."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from prdp_torch.experiments import _C, field_task, scenes
from prdp_torch.experiments.networks import Theta
from prdp_torch.experiments.refinement import Refinement

WAYS = {  # label: colour, title
    "converged": ("#222222", "{}, converged"),
    "multigrid": ("#9467bd", "multigrid, converged"),
    "auto_multigrid": ("#1f77b4", "multigrid, auto"),
}
PANELS = {  # scene: title, solver, what the error is, its ticks and limits
    "diffusion_inverse_256": ("Find this field, on 256²", "CG", "error of the field", (0.01, 0.03, 0.1, 0.3), 0.007),
    "burgers_2d_192": ("Train a network, Burgers 192²", "GMRES(6)", "validation error", (0.1, 0.2, 0.4, 0.8), 0.09),
}


def draw(summaries):
    figure = Figure(figsize=(9.2, 3.5), layout="constrained")
    axes = figure.subplot_mosaic([["true", *PANELS], ["found", *PANELS]], width_ratios=[1, 2.1, 2.1])
    for name, field in zip(("true", "found"), _fields(), strict=True):
        axes[name].imshow(field, vmin=-1, vmax=1, cmap="RdBu_r", origin="lower")
        axes[name].set(title=f"{name} log κ", xticks=[], yticks=[])
    for scene, (title, solver, error, ticks, low) in PANELS.items():
        _errors(axes[scene], summaries[scene]["curves"], solver)
        axes[scene].set(title=title, xlabel="seconds on one CPU core, one seed", ylabel=error, yscale="log")
        axes[scene].set(xlim=(0, None), ylim=(low, None))
        axes[scene].yaxis.set_major_locator(FixedLocator(ticks))
        axes[scene].yaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes[scene].yaxis.set_minor_locator(NullLocator())
    return figure


def _errors(axes, curves, solver):
    for label, (colour, title) in WAYS.items():
        spent, errors = np.cumsum([0, *curves[label]["seconds"]]), curves[label]["metric"]
        axes.plot(spent, errors, color=colour, lw=1.6, label=title.format(solver))
        axes.plot(spent[-1], errors[-1], "o", color=colour, ms=6)
    axes.legend(frameon=False, loc="upper right")
    axes.grid(alpha=0.3, lw=0.4)
    axes.spines[["top", "right"]].set_visible(False)


def _fields():
    """log κ beside its mean in the scene diffusion_inverse, on 64²: true, and found with auto in a second."""
    scene = scenes.load("diffusion_inverse")
    stepper = scenes.make_stepper(scene)
    controller = Refinement.auto().attach([stepper])
    task = field_task.make_task(scene, [stepper], seed=0, found=Theta(scene))
    for update in range(scene.training.intervals):
        list(task.updates(update))
        controller.step(task.error(task.metric()))
    true = _C.make_field_problem(scene, 0).reference.log()
    return [(field - true.mean()).squeeze().numpy() for field in (true, task.state()["theta"])]
