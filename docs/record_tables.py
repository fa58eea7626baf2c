"""Write the table of docs/records.md: which command made which record, on which commit and processor.

Run it after new records: python -m docs.record_tables
"""

import json
from pathlib import Path

from benchmarks import records
from docs import page_tables

DOCS = Path(__file__).parent
PAGE = DOCS / "records.md"
SCRIPT = "record_tables.py"
TABLE = page_tables.places(SCRIPT)
ATLAS = "stability/*.json"
CHECKS = DOCS / "results" / "checks.json"
OTHERS = {  # that are not in the list, as they need two free cores or are long tests; with their minutes
    "performance/calls.json": ("python -m benchmarks.calls", 1),
    "performance/processes.json": ("python -m benchmarks.processes", 10),
    "results/checks.json": ("python -m benchmarks.check_records", 30),
    "stability/forgeries.json": ("python tests/python/forgeries.py --count 10000", 10),
    "stability/kills.json": ("python tests/python/kills.py --kills 100", 60),
}


def values(part, key):
    """What a record says under this key, at whatever depth: some were made in parts."""
    if isinstance(part, list):
        return {value for item in part for value in values(item, key)}
    if not isinstance(part, dict):
        return set()
    below = {value for item in part.values() for value in values(item, key)}
    return below | ({part[key]} if isinstance(part.get(key), str) else set())


def table(_):
    made = {entry.kept: (entry.shown(), entry.minutes) for entry in records.LIST} | OTHERS
    made[ATLAS] = made.pop("stability")
    parts = {}
    checks = json.loads(CHECKS.read_text())
    for path in sorted(DOCS.rglob("*.json")):
        name = str(path.relative_to(DOCS))
        parts.setdefault(name if name in made else ATLAS, []).append(json.loads(path.read_text()))
    return page_tables.markdown(
        ["record", "made by", "minutes", "commit", "processor", "checked"],
        [[*_row(name, made, found), _check(checks.get(name))] for name, found in parts.items()],
    )


def _row(name, made, found):
    command, minutes = made[name]
    commits = {commit[:7] for text in values(found, "commit") for commit in text.split(", ")}
    processors = sorted(values(found, "processor"))
    return [
        f"`{name}`",
        f"`{command.removesuffix(' --resume')}`",
        str(minutes),
        ", ".join(sorted(commits)),
        "; ".join(processors),
    ]


def _check(found):
    if found is None:
        return ""
    same = found["same"].values()
    return f"{sum(same)} of {len(same)} rows the same on {found['commit'][:7]}"


def with_tables(page):
    """Return the text of the page with its table written anew."""
    return page_tables.with_tables(page, SCRIPT, table)


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
