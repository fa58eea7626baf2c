"""`python -m benchmarks.check_records [NAME ...]`: does this commit still compute what the records say?

On one processor a training is deterministic: it ends at the same error after the same products, to the last digit,
until a change touches what is computed. So the first seed of a row tells, and rows that take long can be left out. What
is found goes to docs/checks.json. Rows of another processor, or without the values of each seed, are passed
over."""

import argparse
import json
import math
import sys
import tempfile
from pathlib import Path

import torch

from benchmarks import refinement
from benchmarks.records import LIST
from prdp_torch.experiments import compare, records, scenes

DOCS = Path(__file__).parents[1] / "docs"
FOUND = DOCS / "checks.json"
KNOWN = {entry.name: entry for entry in LIST if entry.command.startswith("-m benchmarks.refinement ")}


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.check_records", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(KNOWN)}; all where none is given")
    parser.add_argument("--limit", type=float, default=100.0, help="leave out rows that took more seconds")
    options = parser.parse_args()
    if unknown := set(options.names) - set(KNOWN):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; allowed: {', '.join(KNOWN)}")
    torch.set_num_threads(1)
    environment = records.environment()
    found = json.loads(FOUND.read_text()) if FOUND.exists() else {}
    all_same = True
    for name in options.names or KNOWN:
        entry = KNOWN[name]
        rows = list(checkable(json.loads((DOCS / entry.kept).read_text()), environment["machine"], options.limit))
        if not rows:
            continue
        same = {row["label"]: is_same(entry.command.split()[2], row, environment) for row in rows}
        found[entry.kept] = {**environment, "same": same}
        records.write(FOUND, found)
        all_same = all_same and all(same.values())
    sys.exit(not all_same)


def checkable(record, machine, limit):
    """The rows of a record that this processor has trained, and seed by seed, in at most `limit` seconds."""
    for row in record["rows"]:
        made_on = row.get("machine", record["machine"])["processor"]
        if "each" in row and made_on == machine["processor"] and row["seconds"] <= limit:
            yield row


def is_same(name, kept, environment):
    """Train the first seed of a row again; whether error and products are those of the record."""
    row = next(row for row in refinement.rows_of(scenes.load(name)) if row.label == kept["label"])
    scene = refinement.scene_of(name, row)
    with tempfile.TemporaryDirectory() as folder:
        row.curves.append(compare.run_one(scene, row.label, row.refinement, 0, Path(folder), environment))
    (now,) = compare.summarise(scene, [row])
    values = [_of_first_seed(entry["each"]) for entry in (kept, now)]
    print(f"{scene.name}, {row.title}: (error, products) {values[0]} in the record, {values[1]} now", flush=True)
    return values[0] == values[1]


def _of_first_seed(each):
    error, products = each["metric"][0], each["operator_applications"][0]
    return (error if error is not None and math.isfinite(error) else None), products


if __name__ == "__main__":
    main()
