"""What a comparison shows: a table for the terminal and one HTML file with the charts inside."""

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from prdp_torch.experiments import _C, records
from prdp_torch.experiments.compare import Entry, Row, verdict
from prdp_torch.experiments.trajectories import Trajectories

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Column(NamedTuple):
    short: str
    """Heading in the terminal."""
    long: str
    """Heading on the page."""
    note: str = ""


def columns(scene: _C.Scene) -> list[Column]:
    """The table's columns, in order."""
    target = scene.compare.target
    error = {"parameters": "parameter error", "field": "error of the field"}.get(scene.task, "validation error")
    until = "" if target is None else f" to an error of {target:g}"
    unit = f"{scene.unit}s"
    reached = []
    if target is not None:
        reached.append(Column(unit, unit + until, f"{unit}:{until}; a run that misses it counts in full."))
    return [
        Column("", "", "Converged: K_ε, the converged solver's K. !: the controller warns, or solves fail to the end."),
        Column(
            "error", f"final {error}", "" if scene.task == "parameters" else "± one standard deviation over the seeds."
        ),
        Column("last K", "last K", "last K: for auto and rtol, the iterations of their last solves."),
        *reached,
        Column(
            "", f"iterations allowed{until}", f"Iterations allowed: K summed over the solves{until}, the paper's count."
        ),
        Column("", "of these saved"),
        Column("", "iterations taken", "A solve that meets its tolerance takes fewer than K."),
        Column("forward", "forward products"),
        Column(
            "adjoint",
            "adjoint products",
            "forward, adjoint: products with A in the solves. They and the iterations are per sample of a batch.",
        ),
        Column(
            "saved",
            "products saved",
            "saved: share of the converged run's products, given only if the error is at most one standard deviation, "
            "or a tenth, above that of the converged run and it does not warn.",
        ),
        Column("s", "seconds of training (median)"),
    ]


def cells(scene: _C.Scene, entry: Entry) -> list[str]:
    """A row of the table as text, in the order of `columns`."""
    spread = f" ±{entry['metric_std']:.0e}" if entry["metric_std"] else ""
    exact = entry["kind"] == "direct"
    missed = entry["reaches_target"] is False
    plain = exact or entry["kind"] == "converged"
    forward = entry["operator_applications"] - entry["adjoint_applications"]
    row = [
        entry["title"] + (" !" if entry["warning"] else ""),
        f"{entry['diverged']} diverged" if entry["diverged"] else f"{entry['metric']:.2e}{spread}",
        "–" if exact else f"{entry['last_k']:.1f}".removesuffix(".0"),
        "–" if exact or entry["saved"] is None else f"{entry['budget']:,.0f}",
        "–" if plain or entry["saved"] is None else _saving(entry, "saved"),
        "–" if exact else f"{entry['iterations']:,.0f}",
        f"{forward:,.0f}",
        f"{entry['adjoint_applications']:,.0f}",
        "–" if plain else _saving(entry, "products_saved"),
        f"{entry['seconds']:.2f}",
    ]
    if scene.compare.target is not None:
        row.insert(3, "never" if missed else f"{entry['intervals']:.0f}")
    return row


def _saving(entry: Entry, name: str) -> str:
    return verdict(entry) or f"{100 * entry[name]:.1f} %"


def in_terminal(scene: _C.Scene) -> list[int]:
    """The columns that eighty characters hold, by index."""
    return [i for i, column in enumerate(columns(scene)) if column.short or i == 0]


def notes(scene: _C.Scene, kept: Sequence[int] | None = None) -> str:
    """What the columns mean; of those `kept` by index, or all."""
    return " ".join(c.note for i, c in enumerate(columns(scene)) if c.note and (kept is None or i in kept))


def headline(scene: _C.Scene, table: list[Entry]) -> str:
    """What the comparison shows of auto and of PRDP, in a sentence each, whichever way it went."""
    base = table[0]
    tried = [entry for entry in table if entry["kind"] in ("auto", "prdp")]
    if base["diverged"] or any(entry["diverged"] for entry in tried):
        counts = [f"{entry['diverged']} with {_short(scene, entry)}" for entry in (*tried[::-1], base)]
        return f"Trainings that diverged: {', '.join(counts)}."
    return " ".join(_verdict(scene, base, entry) for entry in tried)


def failures(scene: _C.Scene, table: list[Entry]) -> list[str]:
    """The rows that do not end as well as the converged one, and what controllers warn of; a list of sentences.
    The sweep of constant K is there to fail at its coarse end: its rows are only marked."""
    worse = [_short(scene, entry) for entry in table if not entry["as_good"] and not entry["diverged"]]
    said = []
    if worse:
        goal = f"the error of {_short(scene, table[0])}"
        if table[0]["reaches_target"]:
            goal = f"an error of {scene.compare.target:g}"
        said.append(f"Do not reach {goal}: {'; '.join(worse)}.")
    for entry in table:
        if entry["warning"] and entry["kind"] != "constant":
            count = f", {entry['warnings']} of {entry['seeds']} seeds" if entry["seeds"] > 1 else ""
            said.append(f"! {_short(scene, entry)}{count}: {entry['warning']}.")
    return said


def _short(scene: _C.Scene, entry: Entry) -> str:
    return f"K = {scene.max_iter}" if entry["kind"] == "converged" else entry["title"]


def _verdict(scene: _C.Scene, base: Entry, entry: Entry) -> str:
    """How far a row comes and what it saves. Nothing is said of savings where the error is worse or the controller
    warns."""
    name, against = _short(scene, entry), _short(scene, base)
    if scene.compare.target is not None:
        reach = f"an error of {scene.compare.target:g}"
        if not entry["reaches_target"]:
            return f"{name} does not reach {reach} in {entry['intervals']:.0f} {scene.unit}s."
        ending = f"reaches {reach} after {entry['intervals']:.0f} {scene.unit}s"
        if not base["reaches_target"]:
            return f"{name} {ending}; {against} does not."
        if entry["warning"]:
            return f"{name} {ending}, {against} after {base['intervals']:.0f}; it warns."
        return f"{name} {ending}, {against} after {base['intervals']:.0f}, {_savings(base, entry)}."
    spread = f" ± {base['metric_std']:.1e}" if base["metric_std"] else ""
    ending = f"{name} ends at an error of {entry['metric']:.2e}, {against} at {base['metric']:.2e}{spread}"
    if not entry["as_good"]:
        return f"{ending}: it fails."
    return f"{ending}; it warns." if entry["warning"] else f"{ending}: {_savings(base, entry)}."


def _savings(base: Entry, entry: Entry) -> str:
    """Products and seconds: where a network takes the time, the ones say nothing of the others."""

    def change(share: float, what: str) -> str:
        return f"{abs(100 * share):.1f} % {'fewer' if share >= 0 else 'more'} {what}"

    text = change(entry["products_saved"], "products with A")
    if entry["saved"] is not None:
        text += f", {change(entry['saved'], 'iterations allowed')}"
    return f"{text}; {entry['seconds']:.3g} s, where converged solves take {base['seconds']:.3g} s"


def _svg(figure: "Figure") -> str:
    image = io.BytesIO()
    figure.savefig(image, format="svg")
    return base64.b64encode(image.getvalue()).decode()


def write(scene: _C.Scene, rows: list[Row], table: list[Entry], shown: Trajectories | None, folder: Path) -> None:
    """`report.html`, one self-contained file with table, pictures and the scene; each chart also as PNG, and
    `trajectories.gif` for fields in 2D. shown: from `trajectories.collect`, or None."""
    import jinja2  # with matplotlib half a second, which other commands need not wait for

    from prdp_torch.experiments import charts, found, trajectory_charts

    drawn = charts.all_charts(scene, rows, table)
    learned = trajectory_charts.pictures(scene, shown) if shown else found.pictures(scene, rows, folder)
    for name, figure, _ in [*drawn, *learned]:
        charts.write_png(figure, folder / f"{name}.png", dpi=120)
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
        environment=records.environment(scene.device),
        headline=headline(scene, table),
        failures=failures(scene, table),
        columns=[column.long for column in columns(scene)],
        cells=[{"entry": entry, "cells": cells(scene, entry)} for entry in table],
        notes=notes(scene),
        charts=[{"svg": _svg(figure), "caption": caption} for _, figure, caption in drawn],
        learned=[{"svg": _svg(figure), "caption": caption} for _, figure, caption in learned],
        animation=base64.b64encode(animation.read_bytes()).decode() if animation.exists() else None,
    )
    records.write(folder / "report.html", html)
