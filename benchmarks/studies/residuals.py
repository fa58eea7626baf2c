"""How fast the solver of each scene converges: the residual of a typical solve against the iterations (paper,
appendix)."""

import math

import torch

from prdp_torch.experiments import _C, records, scenes
from prdp_torch.experiments.charts import make_figure

SCENES = ("poisson_1p", "poisson_3p_sd", "heat_1d", "heat_2d", "heat_3d", "burgers_1d", "burgers_2d", "navier_stokes")
SCENES = (*SCENES, "diffusion_inverse")
TARGETS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
START = 2  # steps before the solve: the solves of a training start from the network's state after one


def run(study, seeds, quick):
    for name in SCENES[:3] if quick else SCENES:
        scene = scenes.load(name)
        ks = range(1, round(1.2 * scene.max_iter) + 1)
        residuals, products = zip((1.0, 0.0), *_residuals(scene, ks), strict=True)
        row = {"scene": name, "method": _method(scene), "ks": [0, *ks], "residuals": residuals, "products": products}
        study.report(f"{name}: {row['residuals'][-1]:.1e} after {ks[-1]}")
        study.rows.append({**row, **records.environment()})


def _method(scene):
    return f"GMRES({scene.restart})" if scene.method == "gmres" else scene.method


def _residuals(scene, ks):
    """(‖b − A u‖ / ‖b‖, products with A) of each K: the geometric mean and the mean over the samples."""
    stepper = scenes.make_stepper(scene)
    u = _state(scene, stepper)
    stepper.rtol, found = 0.0, []
    with torch.no_grad():
        for k in ks:
            stepper.max_iter = k
            stepper(u)
            residual = math.exp(float(stepper.info.residual.double().log().mean()))
            found.append((residual, float(stepper.info.operator_applications.double().mean())))
    return found


def _state(scene, stepper):
    """A state whose step is a typical solve."""
    if scene.task == "parameters":
        problem = _C.make_parameter_problem(scene)
        return (problem.start @ problem.modes)[None, None]
    if scene.task == "field":
        problem = _C.make_field_problem(scene, 0)
        stepper.operator_at.take(problem.reference)
        return problem.start
    return _C.validation_trajectories(scene, START)[:, START]


def _first(row, target):
    """The first K with a residual of the target or below."""
    return next((str(k) for k, r in zip(row["ks"], row["residuals"], strict=True) if r <= target), "–")


def table(rows):
    lines = [f"| scene | solver | {' | '.join(f'{t:.0e}' for t in TARGETS)} |", "|---" * (2 + len(TARGETS)) + "|"]
    for row in rows:
        lines.append(f"| {row['scene']} | {row['method']} | {' | '.join(_first(row, t) for t in TARGETS)} |")
    return "\n".join(lines)


def chart(rows):
    """Against products with A: an iteration of one solver is not one of another, and GMRES counts cycles."""
    figure, (axes,) = make_figure(height=4.6)
    for row in rows:
        axes.plot(row["products"], row["residuals"], label=f"{row['scene']}, {row['method']}")
    axes.set(xscale="symlog", yscale="log", xlabel="products with A", ylabel="‖b − A u‖ / ‖b‖")
    axes.set(ylim=(1e-7, 3), xlim=(0, None))
    axes.axhline(1e-5, color="#888888", lw=1.2, ls="--")
    axes.grid(alpha=0.3, lw=0.4)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure
