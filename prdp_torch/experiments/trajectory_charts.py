"""The pictures of what trained networks do, drawn from `trajectories.Trajectories`."""

from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

from prdp_torch.experiments import _C
from prdp_torch.experiments.charts import FIXED, WIDTH, Drawn, error_measure, make_figure, mean_and_band
from prdp_torch.experiments.trajectories import Course, Trajectories, field

Contents: TypeAlias = list[tuple[str, np.ndarray]]
"""Names, and fields over time."""

_COARSE = ("#0072b2", "--")
_STATE, _DIFFERENCE = "RdBu_r", "PuOr_r"  # both safe for colour-blind readers
_LARGEST_GIF = 2_000_000  # bytes


def pictures(scene: _C.Scene, shown: Trajectories) -> list[Drawn]:
    """(name, figure, caption) of every picture: the error over time; in 1D space against time, in 2D
    snapshots."""
    missing = f" Left out, for want of weights: {'; '.join(shown.missing)}." if shown.missing else ""
    drawn = [("error_over_time", error_over_time(scene, shown), _error_caption(scene, shown) + missing)]
    first = f"The first validation sample, networks of the first seed.{missing}"
    if len(scene.physics.shape) == 1:
        caption = (
            "Space and time: reference and emulators, in colours that reach to the reference's largest value from "
            f"t = {scene.data.trained_steps} on, and on a scale of their own the differences. {first}"
        )
        drawn.append(("space_time", space_time(scene, shown), caption))
    elif len(scene.physics.shape) == 2:
        drawn.append(("snapshots", snapshots(scene, shown), f"{_field_caption(scene)} {first}"))
    return drawn


def error_over_time(scene: _C.Scene, shown: Trajectories) -> Figure:
    """The error after each step, measured as the metric does."""
    figure, (axes,) = make_figure(height=4.6)
    for course in shown.courses:
        steps = range(1, course.errors.shape[1] + 1)
        mean_and_band(axes, steps, course.errors, _name(scene, course), *FIXED.get(course.kind, _COARSE))
    seen = scene.data.trained_steps
    if scene.data.valid_steps == seen:
        axes.axvline(
            seen, color="#888888", lw=1.2, ls="--", zorder=1, label="last step in the loss,\nstep of the metric"
        )
    else:
        axes.axvline(seen, color="#888888", lw=1.2, ls=":", zorder=1, label="last step in the loss")
        axes.axvline(scene.data.valid_steps, color="#888888", lw=1.2, ls="--", zorder=1, label="step of the metric")
    axes.set(yscale="log", xlabel=_time(scene), ylabel=",\n".join(error_measure(scene)))
    axes.xaxis.set_major_locator(_whole_steps())
    axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure


def space_time(scene: _C.Scene, shown: Trajectories) -> Figure:
    """Reference and emulators, x to the right and t upwards, over their differences."""
    reference = field(scene, shown.reference[0]).numpy()
    states = [(_name(scene, course), field(scene, course.states[0]).numpy()) for course in shown.courses]
    differences = [(f"{name}\nminus reference", state - reference) for name, state in states]
    if len(states) > 1:
        first, last = shown.courses[0].title, shown.courses[-1].title
        differences.insert(0, (f"{last}\nminus {first}", states[-1][1] - states[0][1]))
    scale = _scale(reference[scene.data.trained_steps :])
    farthest = min(scale, max(_scale(content) for _, content in differences))  # one may have blown up
    figure, panels = _grid(2, 1 + len(states), height=6.6)
    for line, contents, colours, limit, label in (
        (panels[0], [("reference", reference), *states], _STATE, scale, "u"),
        (panels[1], differences, _DIFFERENCE, farthest, "difference of u"),
    ):
        line, empty = line[-len(contents) :], line[: -len(contents)]
        for axes, (name, content) in zip(line, contents, strict=True):
            image = axes.imshow(
                content, cmap=colours, vmin=-limit, vmax=limit, origin="lower", interpolation="none",
                aspect="auto", extent=_extent(scene, content),
            )  # fmt: skip
            axes.set(title=name, xlabel="x")
            axes.title.set_fontsize(9)
            axes.yaxis.set_major_locator(_whole_steps())
            axes.tick_params(labelleft=axes is line[0])
        line[0].set_ylabel(_time(scene))
        for axes in empty:
            axes.set_axis_off()
        figure.colorbar(image, ax=list(line), label=label, extend="both")
    return figure


def snapshots(scene: _C.Scene, shown: Trajectories) -> Figure:
    """The fields in rows, at a few times in columns; a colour scale for each time."""
    contents = _fields(scene, shown)
    metric, last = scene.data.valid_steps, shown.reference.shape[1] - 1
    times = sorted({min(t, last) for t in (scene.data.trained_steps, metric, 2 * metric, last)})
    figure, panels = _grid(len(contents), len(times), height=1.2 + 2.1 * len(contents))
    for column, t in zip(panels.T, times, strict=True):
        images = _draw_fields(column, contents, t)
        column[0].set_title(f"t = {t}", fontsize=10)
        figure.colorbar(images[0], ax=list(column), location="bottom", extend="both", aspect=15, pad=0.01)
    for axes, (name, _) in zip(panels[:, 0], contents, strict=True):
        axes.set_ylabel(name)
    figure.supxlabel(_field_name(scene), fontsize=10)
    return figure


def animate(scene: _C.Scene, shown: Trajectories, path: Path) -> None:
    """Write the fields over time as a GIF, whole or not at all and small enough for a page."""
    contents = _fields(scene, shown)
    figure, (panels,) = _grid(1, len(contents), height=2.9)
    images = _draw_fields(panels, contents, 0)
    for axes, (name, _) in zip(panels, contents, strict=True):
        axes.set_title(name, fontsize=9)
    figure.colorbar(images[0], ax=panels, label=_field_name(scene), extend="both")
    clock = figure.supxlabel("t", fontsize=10)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # nothing moves from now on but the fields

    def show(t: int) -> None:
        clock.set_text(f"t = {t} step{'s' if t != 1 else ''} of Δt = {scene.physics.dt:g}")
        scale = _scale(contents[0][1][t])
        images[0].set_clim(-scale, scale)  # all images and the bar have the same norm
        for image, (_, content) in zip(images, contents, strict=True):
            image.set_data(content[t])

    unfinished = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        for dpi in (110, 80, 60, 40):
            writer = PillowWriter(fps=4)
            with writer.saving(figure, unfinished, dpi):
                for t in range(len(contents[0][1])):
                    show(t)
                    writer.grab_frame()
            if unfinished.stat().st_size <= _LARGEST_GIF:
                break
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _grid(rows: int, columns: int, height: float) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _name(scene: _C.Scene, course: Course) -> str:
    if course.kind == "coarse":
        return course.title
    return f"{'corrected' if scene.task == 'corrector' else 'emulator'} ({course.title})"


def _whole_steps() -> MaxNLocator:
    return MaxNLocator(integer=True, steps=[1, 2, 5, 10])


def _time(scene: _C.Scene) -> str:
    return f"t in steps of Δt = {scene.physics.dt:g}"


def _field_name(scene: _C.Scene) -> str:
    if scene.task == "corrector":
        return "vorticity ∂u₂/∂x − ∂u₁/∂y"
    return "u₁" if scene.physics.channels > 1 else "u"


def _field_caption(scene: _C.Scene) -> str:
    name, sides = _field_name(scene), scene.physics.length or [1.0]
    square = len(set(sides)) == 1
    box = f"a square of side {sides[0]:g}" if square else f"a box of {' × '.join(f'{side:g}' for side in sides)}"
    return f"{name[0].upper()}{name[1:]} over {box}; each time has its colour scale."


def _error_caption(scene: _C.Scene, shown: Trajectories) -> str:
    seeds = max(len(course.errors) for course in shown.courses)
    spread = f" (line: mean of {seeds} seeds, band: one standard deviation)" if seeds > 1 else ""
    of = "relative error of the velocity along x" if scene.task == "corrector" else "relative error"
    return (
        f"The error from the validation samples on, over more steps than the training knows{spread}: at the step of "
        f"the metric it is the metric. It is the mean square of the {of}: 1e-2 is a tenth of the reference."
    )


def _fields(scene: _C.Scene, shown: Trajectories) -> Contents:
    """(name, (time, Ny, Nx)) of the reference and of each course, the first validation sample."""
    named = [("reference", shown.reference), *((_name(scene, course), course.states) for course in shown.courses)]
    return [(name.replace(" (", "\n("), field(scene, states[0]).numpy()) for name, states in named]


def _draw_fields(panels: Iterable[Axes], contents: Contents, t: int) -> list[AxesImage]:
    """Step t of each field in a panel of its own, in the colour scale of the first, the reference."""
    scale = _scale(contents[0][1][t])
    norm = Normalize(-scale, scale)
    for axes in panels:
        axes.set(xticks=[], yticks=[])
    return [
        axes.imshow(content[t], cmap=_STATE, norm=norm, origin="lower", interpolation="none")
        for axes, (_, content) in zip(panels, contents, strict=True)
    ]


def _scale(content: np.ndarray) -> float:
    """The largest finite magnitude."""
    return float(np.abs(content[np.isfinite(content)]).max(initial=1e-30))


def _extent(scene: _C.Scene, content: np.ndarray) -> tuple[float, float, float, float]:
    """Left, right, lower and upper edge of an image whose pixels are the unknowns of an axis at each step."""
    steps, n = content.shape
    first = 0 if scene.physics.periodic else 1
    dx = 1 / (n + first)
    return (first - 0.5) * dx, (first + n - 0.5) * dx, -0.5, steps - 0.5
