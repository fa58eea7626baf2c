"""Write the tables of results in README.md, docs/refinement.md and docs/results.md from the records in docs/results.

Run it after new records: python docs/result_tables.py
"""

import json
import re
from pathlib import Path

DOCS = Path(__file__).parent
PAGES = (DOCS.parent / "README.md", DOCS / "refinement.md", DOCS / "results.md")
TABLE = re.compile(r"^(<!-- docs/result_tables.py writes ([^\n]+) -->\n).*?^(<!-- end -->)$", re.M | re.S)

SCENES = ("poisson_1p", "poisson_3p", "poisson_3p_sd", "heat_1d", "heat_2d", "burgers_1d", "burgers_2d")
SCENES = (*SCENES, "diffusion_inverse")
BOLD = ("auto", "prdp")


def record(name):
    return json.loads((DOCS / "results" / f"{name}.json").read_text())


def rows(name):
    return {row["label"]: row for row in record(name)["rows"]}


def error(row):
    """The error at the end, or after how many updates the target was reached."""
    warns = ", warns" if row.get("warnings") else ""
    if row["reaches_target"]:
        return f"after {row['intervals']:.0f} updates{warns}"
    missed = ", not reached" if row["reaches_target"] is False else ""
    return f"{_with_spread(row)}{missed}{warns}"


def _with_spread(row):
    spread = row["metric_std"]
    return f"{row['metric']:.2e} ± {spread:.1e}" if spread else f"{row['metric']:.2e}"


def _products(row):
    adjoint = row["adjoint_applications"]
    whole = row["operator_applications"]
    return f"{whole - adjoint:,.0f}", f"{adjoint:,.0f}", f"{whole:,.0f}"


def _seconds(row):
    return f"{row['seconds']:.2g}" if row["seconds"] < 10 else f"{row['seconds']:.0f}"


def _table(head, body):
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines).replace("|  |", "| |") + "\n"


def parts_of_auto():
    """Converged, PRDP and the parts of auto, of every scene."""
    body = []
    for name in SCENES:
        found = record(f"refinement_{name}")
        seeds = f", {found['seeds']} seeds" if found["seeds"] > 1 else ""
        for i, row in enumerate(found["rows"]):
            title = "**auto**" if row["label"] == "auto" else row["title"]
            body.append([f"{name}{seeds}" if i == 0 else "", title, error(row), *_products(row), _seconds(row)])
    return _table(["scene", "", "error", "forward", "adjoint", "in all", "s"], body)


def shares_of_auto():
    """Auto's error and products over those of the converged row and of tuned PRDP."""
    body = []
    for name in SCENES:
        found = rows(f"refinement_{name}")
        auto, prdp, base = found["auto"], found["prdp"], found["converged"]
        over = [
            f"{auto[cost] / other[cost]:.2f}" for cost in ("metric", "operator_applications") for other in (base, prdp)
        ]
        body.append([name, *over])
    head = ["scene", "error: auto / converged", "auto / tuned PRDP", "products: auto / converged", "auto / tuned PRDP"]
    return _table(head, body)


def comparison(name):
    """The rows of `prdp compare`."""
    body = []
    for row in record(name)["rows"]:
        title = f"**{row['title']}**" if row["label"] in BOLD else row["title"]
        last = "–" if row["kind"] == "direct" else f"{row['last_k']:.3g}"
        body.append([title, error(row), last, *_products(row), _saved(row), _seconds(row)])
    return _table(["", "error", "last K", "forward", "adjoint", "in all", "products saved", "s"], body)


def _saved(row):
    if row["kind"] in ("converged", "direct"):
        return "–"
    return f"{row['products_saved']:.1%}".replace("%", " %") if row["as_good"] and not row["warnings"] else "fails"


def readme():
    """Converged, auto and PRDP of the scenes that train a network, or a field."""
    body = []
    for name in ("heat_1d", "burgers_1d", "burgers_2d", "heat_2d", "diffusion_inverse"):
        found = rows(f"refinement_{name}")
        base = found["converged"]
        body.append([f"{name}, {base['seeds']} seeds", "converged", _with_spread(base), "–", "–"])
        for label, title in (("auto", "**auto**"), ("prdp", "PRDP, tuned")):
            row = found[label]
            costs = ("operator_applications", "seconds")
            body.append(["", title, _with_spread(row), *(_percent(1 - row[cost] / base[cost]) for cost in costs)])
    return _table(["scene", "", "error", "products saved", "time saved"], body)


def _percent(share):
    return f"{100 * share:.0f} %"


TABLES = {"the parts of auto": parts_of_auto, "the shares of auto": shares_of_auto, "the README's table": readme}


def table(name):
    kind, _, scene = name.partition(" of ")
    return comparison(scene) if kind == "the comparison" else TABLES[name]()


def with_tables(page):
    """Return the text of a page with its tables written anew."""
    return TABLE.sub(lambda found: f"{found[1]}\n{table(found[2])}\n{found[3]}", page)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(with_tables(path.read_text()))
