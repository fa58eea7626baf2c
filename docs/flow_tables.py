"""Write the tables of flows in docs/performance.md and docs/appendix/flows.md from the records in docs/flows.

A place in the page names a task and a table of it, as `python -m benchmarks.mosaic` prints them, or the short table
here. Run this after new records: python -m docs.flow_tables
"""

import json
from pathlib import Path

from benchmarks.mosaic import solvers, tables
from docs import page_tables

DOCS = Path(__file__).parent
RECORDS = DOCS / "flows"
PAGES = [DOCS / "performance.md", DOCS / "appendix" / "flows.md"]
SCRIPT = "flow_tables.py"
TABLE = page_tables.places(SCRIPT)

SHORT = {
    f"{n}{power}, {steps} steps": {"dim": dim, "n": n, "steps": steps}
    for dim, power, steps, sizes in ((2, "²", 100, (64, 128, 256)), (3, "³", 50, (32, 64)))
    for n in sizes
}
SHOWN = ("ours", "ours_direct", "jax_cfd_central", "phiflow_central", "exponax_stored")


def rows_of(task):
    return json.loads((RECORDS / f"{task}.json").read_text())["rows"]


def short():
    """Seconds of a rollout with its gradient; in brackets, without."""

    def cell(result):
        forward, both = (tables.seconds(result[f"{part}_seconds"])[:-2] for part in ("forward", "gradient"))
        return f"{both} ({forward})"

    return tables.grid(rows_of("cost"), SHORT, cell, {name: solvers.FLOWS[name] for name in SHOWN})


def table(what):
    """`what` is "the seconds of flows", or the title of a table, which begins with its task."""
    if what == "the seconds of flows":
        return short()
    task = what.replace(",", ":").split(":")[0]
    return tables.of(task, rows_of(task))[what]


def with_tables(page):
    """Return the text of the page with its tables written anew."""
    return page_tables.with_tables(page, SCRIPT, table)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(with_tables(path.read_text()))
