"""What a comparison shows: a table for the terminal and one HTML file with the charts inside."""

import base64
import io
from pathlib import Path

import jinja2

from prdp_torch import charts, records


def columns(scene):
    """Headings of the table: (short, for the terminal; long, for the page)."""
    error = "validation error" if scene.task == "emulator" else "parameter error"
    until = "" if scene.compare.target is None else f" to an error of {scene.compare.target:g}"
    names = [
        ("", ""),
        ("error", f"final {error}"),
        ("last K", "last K"),
        ("allowed", f"iterations allowed{until}"),
        ("saved", "saved"),
        ("taken", "iterations taken"),
        ("A·v", "products with A"),
        ("s", "seconds of training"),
    ]
    if scene.compare.target is not None:
        interval = "epochs" if scene.task == "emulator" else "updates"
        names.insert(3, (interval, f"{interval}{until}"))
    return names


def cells(scene, entry):
    """A row of the table as text, in the order of `columns`."""
    spread = f" ±{entry['metric_std']:.0e}" if entry["metric_std"] else ""
    exact = entry["kind"] == "direct"
    missed = entry["reaches_target"] is False
    row = [
        entry["title"],
        f"{entry['metric']:.2e}{spread}",
        "–" if exact else f"{entry['last_k']:.1f}".removesuffix(".0"),
        "–" if exact else f"{entry['budget']:,.0f}",
        "–" if exact or missed or entry["kind"] == "converged" else f"{100 * entry['saved']:.1f} %",
        "–" if exact else f"{entry['iterations']:,.0f}",
        f"{entry['operator_applications']:,.0f}",
        f"{entry['seconds']:.2f}",
    ]
    if scene.compare.target is not None:
        row.insert(3, "never" if missed else f"{entry['intervals']:.0f}")
    return row


def notes(scene):
    text = (
        "Iterations allowed: K summed over all updates, the paper's count; saved: against the converged run. "
        "Taken: fewer where a solve meets its tolerance before K. A·v: products with A, those of the adjoint "
        "solves included; like the iterations, per sample of a batch."
    )
    if scene.task == "emulator":
        text += " ± is one standard deviation over the seeds."
    if scene.compare.target is not None:
        text += " A run that does not reach the error is counted to its end."
    return text


def headline(scene, table):
    """The comparison in two sentences."""
    by_kind = {entry["kind"]: entry for entry in table}
    base, prdp = by_kind["converged"], by_kind["prdp"]
    saved = f"PRDP was allowed {100 * prdp['saved']:.1f} % fewer iterations than K = {scene.max_iter} throughout"
    if scene.task == "emulator" and base["metric_std"]:
        within = abs(prdp["metric"] - base["metric"]) <= base["metric_std"]
        verdict = "within" if within else "beyond"
        return (
            f"{saved}; its validation error, {prdp['metric']:.2e}, is {verdict} one standard deviation of the "
            f"converged runs' {base['metric']:.2e} ± {base['metric_std']:.1e}."
        )
    return f"{saved}; its error ends at {prdp['metric']:.2e}, the converged run's at {base['metric']:.2e}."


def _svg(figure):
    image = io.BytesIO()
    figure.savefig(image, format="svg")
    return base64.b64encode(image.getvalue()).decode()


def write(scene, rows, table, folder):
    """`report.html`, one self-contained file with table, charts and the scene, and each chart as PNG."""
    drawn = list(charts.all_charts(scene, rows, table))
    for name, figure, _ in drawn:
        figure.savefig(folder / f"{name}.png", dpi=120)
    template = jinja2.Environment(autoescape=True).from_string(
        Path(__file__).with_name("report.html.j2").read_text(encoding="utf-8")
    )
    html = template.render(
        scene=scene,
        seeds=len(rows[0].curves),
        environment=records.environment(),
        headline=headline(scene, table),
        columns=[heading for _, heading in columns(scene)],
        cells=[{"kind": entry["kind"], "cells": cells(scene, entry)} for entry in table],
        notes=notes(scene),
        charts=[{"svg": _svg(figure), "caption": caption} for _, figure, caption in drawn],
    )
    records.write(folder / "report.html", html)
