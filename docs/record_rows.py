"""The rows of the records in docs/results, and the cells that tables and pictures make of them."""

import json
from pathlib import Path
from statistics import median

DOCS = Path(__file__).parent
# Seconds are no more certain than this: heat_2d with auto takes 62 s in one record and 79 s in another, on the same
# kind of processor.
NOISE_OF_TIME = 0.3


def record(name):
    return json.loads((DOCS / "results" / f"{name}.json").read_text())


def rows(name):
    return by_label(record(name))


def by_label(found):
    return {row["label"]: row for row in found["rows"]}


def of_scene(name, seeds):
    return f"{name}, {seeds} seeds" if seeds > 1 else name


def title(row, seeds):
    """With how many seeds the row has, where the record has more."""
    return ("**auto**" if row["label"] == "auto" else row["title"]) + fewer_seeds(row, seeds)


def error(row):
    """The error at the end, or after how many updates the target was reached; and how many of the seeds warn."""
    warns = f", {_warns(row)}" if row["warnings"] else ""
    if row["diverged"]:
        return f"{row['diverged']} of {row['seeds']} diverged{warns}"
    if row["reaches_target"]:
        return f"after {row['intervals']:.0f} updates{warns}"
    missed = ", not reached" if row["reaches_target"] is False else ""
    return f"{_with_spread(row)}{missed}{warns}"


def _warns(row):
    return "warns" if row["seeds"] == 1 else f"{row['warnings']} of {row['seeds']} warn"


def _with_spread(row):
    spread = row["metric_std"]
    return f"{row['metric']:.2e} ± {spread:.1e}" if spread else f"{row['metric']:.2e}"


def fewer_seeds(row, seeds):
    """How many seeds a row has, where others have more."""
    return "" if row["seeds"] == seeds else ", one seed" if row["seeds"] == 1 else f", {row['seeds']} seeds"


def claims(row):
    """Whether the row ends as well as the converged one, without a warning."""
    return row["as_good"] and not row["warnings"]


def claim(row, share, digits=0):
    """A share that the row saves, unless it ends worse than the converged one or its controller warns."""
    if not row["as_good"]:
        return "fails"
    return "warns" if row["warnings"] else percent(share, digits)


def saved(row):
    """Of the products with A."""
    return "–" if row["kind"] in ("converged", "direct") else claim(row, row["products_saved"], 1)


def share_of_products(row, base):
    """What the row saves of those of another."""
    return 1 - row["operator_applications"] / base["operator_applications"]


def share_of_seconds(row, base):
    return 1 - median_seconds(row) / median_seconds(base)


def products_saved(row, base):
    return claim(row, share_of_products(row, base))


def time_saved(row, base):
    share = share_of_seconds(row, base)
    said = claim(row, share)
    return "none" if said.endswith("%") and abs(share) < NOISE_OF_TIME else said


def products(row):
    """Forward, adjoint and in all."""
    adjoint = row["adjoint_applications"]
    whole = row["operator_applications"]
    return f"{whole - adjoint:,.0f}", f"{adjoint:,.0f}", f"{whole:,.0f}"


def median_seconds(row):
    """Over the seeds; the mean where an older record holds no other."""
    return median(row.get("each", {}).get("seconds") or [row["seconds"]])


def seconds(row):
    return shown(median_seconds(row))


def seconds_beside(row, found):
    """Nothing where the row was trained on another processor than the converged one, or on several."""
    base = found["rows"][0]
    mine, its = (r.get("machine", found["machine"])["processor"] for r in (row, base))
    return seconds(row) if mine == its else "–"


def shown(value):
    """Two digits, or all before the point."""
    return f"{value:.2g}" if value < 10 else f"{value:,.0f}"


def power(rtol):
    return f"{rtol:.0e}".replace("e-0", "e-")


def percent(share, digits=0):
    return f"{100 * share:.{digits}f} %".replace("-", "−")
