"""Write the figures in the prose of README.md and docs from the records in docs/results.

A figure stands between `<!--= WHAT -->` and `<!--/-->`, which neither a code host nor the site shows. Run it after new
records: python -m docs.figures
"""

import re
from pathlib import Path

from docs import flow_tables, result_tables
from docs.record_rows import (
    DOCS,
    NOISE_OF_TIME,
    claim,
    percent,
    rows,
    seconds,
    share_of_products,
    share_of_seconds,
    shown,
)

PLACE = re.compile(r"<!--= ([^>]+?) -->([^<]*)<!--/-->")
PAGES = [path for path in (DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))) if PLACE.search(path.read_text())]


def _row(scene, label):
    """Of the record refinement_SCENE, or of another that `prdp compare` made: "comparison:SCENE"."""
    return rows(scene.removeprefix("comparison:") if ":" in scene else f"refinement_{scene}")[label]


def _share_over(scene, label, other, share):
    """What a row saves beside another, or that it fails or warns."""
    row = _row(scene, label)
    return claim(row, share(row, _row(scene, other)))


def _ratio(scene, label, other, key):
    return _row(scene, label)[key] / _row(scene, other)[key]


def _of_flow(solver, dim, n, steps):
    case = {"dim": int(dim), "n": int(n), "steps": int(steps)}
    (row,) = (row for row in flow_tables.rows_of("cost") if row["solver"] == solver and row["case"] == case)
    return shown(row["result"]["gradient_seconds"])


def _warnings(which, what):
    """Of networks and fields: rows that end badly after a warning in all seeds, or well without one."""
    table = [line.split(" | ") for line in result_tables.what_a_warning_predicts().splitlines()]
    (cells,) = (line for line in table if line[0] == "| networks and fields" and line[1] == which)
    number, fail, good = (int(cell.strip(" |")) for cell in cells[2:])
    return f"{fail if what == 'fail' else good} of {number}"


FIGURES = {
    r"seconds of (\S+), (\S+)": lambda scene, label: seconds(_row(scene, label)),
    r"error of (\S+), (\S+)": lambda scene, label: f"{_row(scene, label)['metric']:.3g}",
    r"last K of (\S+), (\S+)": lambda scene, label: f"{_row(scene, label)['last_k']:.3g}",
    r"time saved of (\S+), (\S+) over (\S+)": lambda *of: _share_over(*of, share_of_seconds),
    r"products saved of (\S+), (\S+) over (\S+)": lambda *of: _share_over(*of, share_of_products),
    r"share of seconds of (\S+), (\S+) over (\S+)": lambda scene, label, other: percent(
        1 - share_of_seconds(_row(scene, label), _row(scene, other))
    ),
    r"share of iterations of (\S+), (\S+) over (\S+)": lambda *of: percent(_ratio(*of, "budget")),
    r"error of (\S+), (\S+) over (\S+)": lambda *of: f"{_ratio(*of, 'metric'):.2g}",
    r"error of (\S+), (\S+) above (\S+)": lambda *of: percent(_ratio(*of, "metric") - 1),
    r"products of (\S+), (\S+) over (\S+)": lambda *of: f"{_ratio(*of, 'operator_applications'):.2g}",
    r"seconds of a flow by (\S+), (\d)D, N = (\d+), (\d+) steps": _of_flow,
    r"the noise of seconds": lambda: percent(NOISE_OF_TIME),
    r"rows of which (all|some|none) seeds warn that (fail|do not)": _warnings,
}


def figure(what):
    for pattern, write in FIGURES.items():
        if found := re.fullmatch(pattern, what):
            return write(*found.groups())
    raise ValueError(f"unknown figure {what!r}; known: {', '.join(FIGURES)}")


def with_figures(page):
    """Return the text of a page with its figures written anew."""
    return PLACE.sub(lambda found: f"<!--= {found[1]} -->{figure(found[1])}<!--/-->", page)


def main():
    for path in PAGES:
        path.write_text(with_figures(Path(path).read_text()))


if __name__ == "__main__":
    main()
