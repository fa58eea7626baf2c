"""What a task without a network has found, beside what was to be found: the arrays and the picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from prdp_torch.experiments import _C, records
from prdp_torch.experiments.charts import FIXED, WIDTH, Drawn, make_figure
from prdp_torch.experiments.compare import Row
from prdp_torch.experiments.networks import make_network

_SHOWN = ("converged", "direct", "auto", "prdp")  # kinds of rows


def pictures(scene: _C.Scene, rows: list[Row], folder: Path) -> list[Drawn]:
    """What the first seeds have found, whose θ lie beside their records in `folder`; of a field in 3D the plane in
    the middle of its first axis. Nothing for a task with a network, or where no θ is left."""
    if scene.trains_network:
        return []
    shown = [row for row in rows if row.kind in _SHOWN and "diverged" not in row.curves[0]]
    found = [(row, _found(scene, folder / row.label / "seed_0.json")) for row in shown]
    left = [(row, values) for row, values in found if values is not None]
    if not left:
        return []
    if scene.task == "parameters":
        reference = _C.make_parameter_problem(scene).reference.cpu().numpy()
        caption = "θ, one number for each mode of the load: to be found, and found."
        return [("found", _lines(reference, left, "mode", 1 + np.arange(len(reference)), "θ"), caption)]
    reference = _C.make_field_problem(scene, 0).reference.cpu().numpy()
    if reference.ndim == 1:
        cells = (np.arange(len(reference)) + 0.5) / len(reference)
        return [("found", _lines(reference, left, "x", cells, "κ"), "κ to be found, and found by the first seed.")]
    plane = " In the middle of the first axis." if reference.ndim == 3 else ""
    caption = f"κ to be found, found by the first seed, and below it the difference.{plane}"
    planes = [(row, _plane(values)) for row, values in left]
    return [("found", _images(_plane(reference), planes), caption)]


def _plane(values: np.ndarray) -> np.ndarray:
    plane: np.ndarray = values[len(values) // 2] if values.ndim == 3 else values
    return plane


def _found(scene: _C.Scene, path: Path) -> np.ndarray | None:
    """κ of a field, else θ."""
    theta = records.read_weights(path, make_network(scene, 0))
    if theta is None:
        return None
    values = next(theta.parameters()).detach()
    return np.asarray(values.exp() if scene.task == "field" else values)


def _lines(reference: np.ndarray, found: Sequence[tuple[Row, np.ndarray]], x: str, at: np.ndarray, y: str) -> Figure:
    figure, (axes,) = make_figure()
    mark = "o" if len(reference) < 30 else ""
    axes.plot(at, reference, color="#bbbbbb", lw=5, marker=mark, ms=11, label="to be found")
    for row, values in found:
        colour, line = FIXED[row.kind]
        axes.plot(at, values, color=colour, ls=line, marker=mark, ms=5, label=row.title)
    axes.set(xlabel=x, ylabel=y)
    if x == "mode":
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure


def _images(reference: np.ndarray, found: Sequence[tuple[Row, np.ndarray]]) -> Figure:
    """Two rows: the fields in the colours of the reference, and the differences on a scale of their own."""
    figure = Figure(figsize=(WIDTH, 3.9), layout="constrained")
    panels = figure.subplots(2, 1 + len(found), squeeze=False)
    for axes in panels.flat:
        axes.set(xticks=[], yticks=[])
    fields = [("to be found", reference), *((row.title, values) for row, values in found)]
    scale = {"vmin": reference.min(), "vmax": reference.max(), "cmap": "viridis"}
    for axes, (name, values) in zip(panels[0], fields, strict=True):
        image = axes.imshow(values, origin="lower", interpolation="none", **scale)
        axes.set_title(name, fontsize=9)
    figure.colorbar(image, ax=list(panels[0]), label="κ", extend="both")
    differences = [values - reference for _, values in found]
    limit = max(float(np.abs(difference).max()) for difference in differences) or 1e-30
    panels[1, 0].set_axis_off()
    for axes, difference in zip(panels[1, 1:], differences, strict=True):
        image = axes.imshow(difference, origin="lower", interpolation="none", cmap="PuOr_r", vmin=-limit, vmax=limit)
    figure.colorbar(image, ax=list(panels[1]), label="difference of κ")
    return figure
