"""Write the table of docs/appendix/records.md: which command made which record, on which commit and processor.

Run it after new records: python -m docs.record_tables
"""

import json
import re
from pathlib import Path

from benchmarks import records, records_gpu
from docs import page_tables

DOCS = Path(__file__).parent
PAGE = DOCS / "appendix" / "records.md"
SCRIPT = "record_tables.py"
TABLE = page_tables.places(SCRIPT)
ATLAS = "stability/*.json"
CHECKS = DOCS / "checks.json"
OTHERS = {  # that are not in the list, as they need two free cores or a GPU, or are long tests; with their minutes
    "performance/calls.json": ("python -m benchmarks.calls", 1),
    "performance/processes.json": ("python -m benchmarks.processes", 10),
    "checks.json": ("python -m benchmarks.check_records", 30),
    "stability/forgeries.json": ("python tests/python/forgeries.py --count 10000", 10),
    "stability/kills.json": ("python tests/python/kills.py --kills 100", 60),
    **{
        f"{records_gpu.KEPT}/{part.record}.json": (f"python -m benchmarks.records_gpu {part.record}", "")
        for part in records_gpu.PARTS
    },
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
    head = ["record", "commit", "processor", "checked", "minutes", "made by"]
    return page_tables.markdown(head, [_row(name, made, found, checks.get(name)) for name, found in parts.items()])


def _row(name, made, found, check):
    command, minutes = made[name]
    command = command.removesuffix(" --resume").replace("python -m prdp_torch", "prdp")
    commits = {_commit(commit) for text in values(found, "commit") for commit in text.split(", ")}
    processors = {_short(name) for text in values(found, "processor") for name in text.split("; ")}
    checked = ""
    if check:
        same = check["same"].values()
        checked = f"{sum(same)} of {len(same)} the same on {_commit(check['commit'])}"
    return [name, ", ".join(sorted(commits)), ", ".join(sorted(processors)), checked, str(minutes), f"`{command}`"]


def _commit(name):
    """Seven digits, and whether there were changes that were not committed."""
    digits, *dirty = name.split("-")
    return "-".join([digits[:7], *dirty])


def _short(processor):
    """AMD EPYC 25/17, with family and model."""
    return re.sub(r", family (\d+), model (\d+)", r" \1/\2", processor.replace("(R)", "").replace(" Processor", ""))


def with_tables(page):
    """Return the text of the page with its table written anew."""
    return page_tables.with_tables(page, SCRIPT, table)


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
