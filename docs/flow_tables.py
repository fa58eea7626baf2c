"""Write the tables of docs/flows.md from the records in docs/flows.

A place in the page names a task and a table of it, as `python -m benchmarks.mosaic` prints them. Run this after new
records: python -m docs.flow_tables
"""

import json
from pathlib import Path

from benchmarks.mosaic import tables
from docs import page_tables

DOCS = Path(__file__).parent
PAGE = DOCS / "flows.md"
RECORDS = DOCS / "flows"
SCRIPT = "flow_tables.py"
TABLE = page_tables.places(SCRIPT)


def table(what):
    """`what` is the title of a table, which begins with its task."""
    task = what.replace(",", ":").split(":")[0]
    rows = json.loads((RECORDS / f"{task}.json").read_text())["rows"]
    return tables.of(task, rows)[what]


def with_tables(page):
    """Return the text of the page with its tables written anew."""
    return page_tables.with_tables(page, SCRIPT, table)


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
