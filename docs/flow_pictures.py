"""Make the pictures of the recipes in docs/flows.md by running them: python -m docs.flow_pictures."""

import runpy
import sys
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from prdp_torch import fields
from prdp_torch.experiments.charts import write_png

DOCS = Path(__file__).parent
EXAMPLES = DOCS.parent / "examples"
BLUE, RED = "#0072b2", "#d55e00"


def run(name, *arguments):
    """What the names of an example stand for after it has run."""
    before = sys.argv
    sys.argv = [name, *map(str, arguments)]
    try:
        return runpy.run_path(str(EXAMPLES / f"{name}.py"))
    finally:
        sys.argv = before


def flow_around_cylinder(figure):
    ran = run("flow_around_cylinder")
    u, solid, cells = ran["u"].detach()[0], ran["solid"], ran["cells"]
    height, width = ran["height"], ran["width"]
    curl = fields.curl(u[None], (float(height), float(width)))[0, 0]
    vorticity = np.ma.masked_where(solid | solid.roll(1, 0) | solid.roll(1, 1), curl)
    left, right = figure.subplots(1, 2, width_ratios=[3, 1])
    extent = (0, width, 0, height)
    image = left.imshow(vorticity, cmap="RdBu_r", vmin=-3, vmax=3, origin="lower", extent=extent)
    figure.colorbar(image, ax=left, extend="both", location="bottom", label="vorticity", shrink=0.7)
    left.set(xlabel="x in diameters", ylabel="y in diameters", title="Re = 20")
    y = (np.arange(solid.shape[0]) + 0.5) / cells
    right.plot(ran["gradient"], y, color=BLUE)
    right.set(xlabel="∂ drag / ∂ inflow of a row", title="where the inflow matters", ylim=(0, height))


def lid_driven_cavity(figure):
    left, middle, right = figure.subplots(1, 3)
    for reynolds, colour in ((100, BLUE), (400, "#009e73"), (1000, RED)):
        ran = run("lid_driven_cavity", 128, reynolds)
        n, u = ran["n"], ran["u"][0]
        at = (np.arange(n) + 0.5) / n
        left.plot(u[0, :, n // 2], at, color=colour, label=f"Re = {reynolds}")
        left.plot(ran["GHIA"][reynolds], ran["HEIGHTS"], "o", ms=4, color=colour)
        right.plot(at - 0.5 / n, n * ran["gradient"], color=colour)
    left.set(xlabel="u in the middle; points: Ghia et al.", ylabel="y")
    left.legend(frameon=False, fontsize="small")
    centres = (u + torch.stack([u[0].roll(-1, 1), u[1].roll(-1, 0)])) / 2
    centres[0, :, -1] /= 2  # the wall on the right is at rest
    image = middle.imshow(centres.square().sum(0).sqrt(), cmap="viridis", origin="lower", extent=(0, 1, 0, 1))
    middle.streamplot(at, at, *centres.numpy(), color="white", linewidth=0.6, density=1.1, arrowsize=0.6)
    middle.set(title="speed, Re = 1000", xticks=[], yticks=[], xlim=(0, 1), ylim=(0, 1))
    figure.colorbar(image, ax=middle, shrink=0.7)
    right.set(title="∂ u(centre) / ∂ speed of the lid", xlabel="x along the lid")


def passive_scalar(figure):
    ran = run("passive_scalar")
    n, u = ran["n"], ran["u"].detach()[0]
    panels = figure.subplots(1, 3)
    titles = "dye at the start", f"after {ran['steps']} steps", "gradient of the probe"
    shown = zip(titles, (ran["start"], ran["c"], ran["gradient"]), strict=True)
    at = (np.arange(n) + 0.5) / n
    for axes, (title, content) in zip(panels, shown, strict=True):
        content = content.detach()[0, 0]
        axes.imshow(content, cmap="viridis", origin="lower", extent=(0, 1, 0, 1))
        axes.set(title=title, xticks=[], yticks=[])
    panels[1].quiver(at[::4], at[::4], u[0, ::4, ::4], u[1, ::4, ::4], color="white")
    probe = (3 * n // 4 + 0.5) / n, (n // 2 + 0.5) / n
    for axes in panels[1:]:
        axes.plot(*probe, "x", color=RED)


def force_network(figure):
    torch.set_num_threads(1)
    ran = run("force_network")
    flow, network, vortex = ran["flow"], ran["network"], ran["vortex"][None]
    flow.rtol = 1e-5
    kept, free, steps = [1.0], [1.0], 20
    with torch.no_grad():
        u, v = vortex, vortex
        for _ in range(steps):
            flow.force = network(u)
            u = flow(u)
            flow.force = None
            v = flow(v)
            kept.append(float((u * vortex).sum() / vortex.square().sum()))
            free.append(float((v * vortex).sum() / vortex.square().sum()))
        flow.force = network(vortex)
    left, right = figure.subplots(1, 2)
    left.plot(kept, color=BLUE, lw=2, label="with the network's force")
    left.plot(free, color=RED, ls="--", lw=2, label="without")
    left.axvline(5, color="#888888", ls=":", label="last trained step")
    left.set(xlabel="time steps", ylabel="strength of the vortex", ylim=(0, 1.2))
    left.legend(frameon=False)
    force = flow.force[0]
    speed = force.square().sum(0).sqrt()
    image = right.imshow(speed, cmap="viridis", origin="lower")
    every = slice(None, None, 3)
    at = np.arange(ran["n"])[every]
    right.quiver(at, at, force[0, every, every], force[1, every, every], color="white")
    right.set(title="its force on the vortex", xticks=[], yticks=[])
    figure.colorbar(image, ax=right)


def main():
    for draw in (flow_around_cylinder, lid_driven_cavity, passive_scalar, force_network):
        figure = Figure(figsize=(8.5, 3.6), layout="constrained")
        draw(figure)
        path = DOCS / "results" / f"{draw.__name__}.png"
        write_png(figure, path, dpi=80)
        print(path, path.stat().st_size)


if __name__ == "__main__":
    main()
