"""What a comparison shows: a table for the terminal and one HTML file with the charts inside."""

import base64
import io
from pathlib import Path
from typing import NamedTuple

import jinja2

from prdp_torch import charts, records, trajectory_charts


class Column(NamedTuple):
    short: str
    """Heading in the terminal."""
    long: str
    """Heading on the page."""
    note: str = ""


def columns(scene):
    """The table's columns, in order."""
    network, target = scene.task != "parameters", scene.compare.target
    error = "validation error" if network else "parameter error"
    until = "" if target is None else f" to an error of {target:g}"
    unit = f"{scene.unit}s"
    reached = []
    if target is not None:
        reached.append(Column(unit, unit + until, f"{unit}:{until}; a run that misses it counts whole."))
    return [
        Column("", "", "Converged: K_ε, the K that the scene takes for converged."),
        Column("error", f"final {error}", "± one standard deviation over the seeds." if network else ""),
        Column("last K", "last K"),
        *reached,
        Column(
            "allowed", f"iterations allowed{until}", f"allowed: K summed over the solves{until}, the paper's count."
        ),
        Column("saved", "saved", "saved: of the converged run's."),
        Column("taken", "iterations taken", "taken: fewer where a solve meets its tolerance before K."),
        Column(
            "A·v",
            "products with A",
            "A·v: products with A, those of the adjoint solves included; like the iterations, per sample of a batch.",
        ),
        Column("s", "seconds of training"),
    ]


def cells(scene, entry):
    """A row of the table as text, in the order of `columns`."""
    spread = f" ±{entry['metric_std']:.0e}" if entry["metric_std"] else ""
    exact = entry["kind"] == "direct"
    missed = entry["reaches_target"] is False
    unsaved = exact or missed or entry["diverged"] or entry["kind"] == "converged"
    row = [
        entry["title"],
        f"{entry['diverged']} diverged" if entry["diverged"] else f"{entry['metric']:.2e}{spread}",
        "–" if exact else f"{entry['last_k']:.1f}".removesuffix(".0"),
        "–" if exact else f"{entry['budget']:,.0f}",
        "–" if unsaved else f"{100 * entry['saved']:.1f} %",
        "–" if exact else f"{entry['iterations']:,.0f}",
        f"{entry['operator_applications']:,.0f}",
        f"{entry['seconds']:.2f}",
    ]
    if scene.compare.target is not None:
        row.insert(3, "never" if missed else f"{entry['intervals']:.0f}")
    return row


def notes(scene, kept=None):
    """What the columns mean; of those `kept` by index, or all."""
    return " ".join(c.note for i, c in enumerate(columns(scene)) if c.note and (kept is None or i in kept))


def headline(scene, table):
    """What the comparison shows of PRDP, in a sentence or two, whichever way it went."""
    by_kind = {entry["kind"]: entry for entry in table}
    base, prdp = by_kind["converged"], by_kind["prdp"]
    name = f"K = {scene.max_iter}"
    if prdp["diverged"] or base["diverged"]:
        return f"Trainings that diverged: {prdp['diverged']} with PRDP, {base['diverged']} with {name}."
    if scene.compare.target is not None:
        return _to_target(scene, base, prdp, name)
    change = f"{abs(100 * prdp['saved']):.1f} % {'fewer' if prdp['saved'] >= 0 else 'more'} iterations"
    allowed = f"PRDP was allowed {change} than {name} throughout"
    if not base["metric_std"]:
        return f"{allowed}; its error ends at {prdp['metric']:.2e}, that of {name} at {base['metric']:.2e}."
    distance = prdp["metric"] - base["metric"]
    verdict = "within one standard deviation of"
    if abs(distance) > base["metric_std"]:
        verdict = f"{'worse' if distance > 0 else 'better'} by more than one standard deviation than"
    return (
        f"{allowed}; its final error, {prdp['metric']:.2e}, is {verdict} "
        f"{base['metric']:.2e} ± {base['metric_std']:.1e} of {name}."
    )


def _to_target(scene, base, prdp, name):
    """PRDP against the converged run where an error is to be reached."""

    def course(entry):
        if not entry["reaches_target"]:
            return f"did not reach an error of {scene.compare.target:g} in {entry['intervals']:.0f} {scene.unit}s"
        return (
            f"reached an error of {scene.compare.target:g} after {entry['intervals']:.0f} {scene.unit}s and "
            f"{entry['budget']:,.0f} iterations"
        )

    text = f"PRDP {course(prdp)}, {name} {course(base)}"
    if prdp["reaches_target"] and base["reaches_target"]:
        text += f": {abs(100 * prdp['saved']):.1f} % {'fewer' if prdp['saved'] >= 0 else 'more'} iterations"
    return text + "."


def _svg(figure):
    image = io.BytesIO()
    figure.savefig(image, format="svg")
    return base64.b64encode(image.getvalue()).decode()


def write(scene, rows, table, shown, folder):
    """`report.html`, one self-contained file with table, pictures and the scene; each chart also as PNG, and
    `trajectories.gif` for fields in 2D. shown: from `trajectories.collect`, or None."""
    drawn = charts.all_charts(scene, rows, table)
    learned = trajectory_charts.pictures(scene, shown) if shown else []
    for name, figure, _ in [*drawn, *learned]:
        figure.savefig(folder / f"{name}.png", dpi=120)
    animation = folder / "trajectories.gif"
    animation.unlink(missing_ok=True)
    if shown and len(scene.physics.shape) == 2:
        trajectory_charts.animate(scene, shown, animation)
    template = jinja2.Environment(autoescape=True).from_string(
        Path(__file__).with_name("report.html.j2").read_text(encoding="utf-8")
    )
    html = template.render(
        scene=scene,
        seeds=len(rows[0].curves),
        environment=records.environment(),
        headline=headline(scene, table),
        columns=[column.long for column in columns(scene)],
        cells=[{"kind": entry["kind"], "cells": cells(scene, entry)} for entry in table],
        notes=notes(scene),
        charts=[{"svg": _svg(figure), "caption": caption} for _, figure, caption in drawn],
        learned=[{"svg": _svg(figure), "caption": caption} for _, figure, caption in learned],
        animation=base64.b64encode(animation.read_bytes()).decode() if animation.exists() else None,
    )
    records.write(folder / "report.html", html)
