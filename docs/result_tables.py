"""Write the tables of results in README.md and on the pages of docs from the records in docs/results.

A row that ends worse than the converged one, or whose controller warns, claims no saving in any of them.
Run it after new records: python -m docs.result_tables
"""

import importlib
import json
from pathlib import Path
from statistics import median

from docs import page_tables

DOCS = Path(__file__).parent
TABLE = page_tables.places("result_tables.py")
PAGES = [path for path in (DOCS.parent / "README.md", *sorted(DOCS.glob("*.md"))) if TABLE.search(path.read_text())]

SCENES = ("poisson_1p", "poisson_3p", "poisson_3p_sd", "heat_1d", "heat_2d", "burgers_1d", "burgers_2d")
SCENES = (*SCENES, "navier_stokes", "diffusion_inverse")
BOLD = ("auto", "prdp")
# Seconds are no more certain than this: on burgers_1d, 10 seeds, K = 4 takes 13 % longer than K = 16.
NOISE_OF_TIME = 0.15


def record(name):
    return json.loads((DOCS / "results" / f"{name}.json").read_text())


def rows(name):
    return {row["label"]: row for row in record(name)["rows"]}


def error(row):
    """The error at the end, or after how many updates the target was reached; and how many of the seeds warn."""
    warns = f", {_warns(row)}" if row["warnings"] else ""
    if row["diverged"]:
        return f"{row['diverged']} of {row['seeds']} diverged{warns}"
    if row["reaches_target"]:
        return f"after {row['intervals']:.0f} updates{warns}"
    missed = ", not reached" if row["reaches_target"] is False else ""
    return f"{_with_spread(row)}{missed}{warns}"


def _fewer_seeds(row, seeds):
    """How many seeds a row has, where others have more."""
    return "" if row["seeds"] == seeds else ", one seed" if row["seeds"] == 1 else f", {row['seeds']} seeds"


def _warns(row):
    return "warns" if row["seeds"] == 1 else f"{row['warnings']} of {row['seeds']} warn"


def claim(row, share, digits=0):
    """A share that the row saves, unless it ends worse than the converged one or its controller warns."""
    if not row["as_good"]:
        return "fails"
    return "warns" if row["warnings"] else _percent(share, digits)


def _time_saved(row, base):
    share = 1 - _median_seconds(row) / _median_seconds(base)
    said = claim(row, share)
    return "none" if said.endswith("%") and abs(share) < NOISE_OF_TIME else said


def _with_spread(row):
    spread = row["metric_std"]
    return f"{row['metric']:.2e} ± {spread:.1e}" if spread else f"{row['metric']:.2e}"


def _products(row):
    adjoint = row["adjoint_applications"]
    whole = row["operator_applications"]
    return f"{whole - adjoint:,.0f}", f"{adjoint:,.0f}", f"{whole:,.0f}"


def _median_seconds(row):
    """Over the seeds; the mean where an older record holds no other."""
    return median(row.get("each", {}).get("seconds") or [row["seconds"]])


def _seconds(row):
    seconds = _median_seconds(row)
    return f"{seconds:.2g}" if seconds < 10 else f"{seconds:.0f}"


def parts_of_auto():
    """Converged, PRDP and the parts of auto, of every scene."""
    body = []
    for name in SCENES:
        found = record(f"refinement_{name}")
        seeds = f", {found['seeds']} seeds" if found["seeds"] > 1 else ""
        elsewhere = ("rtol_", "direct", "multigrid", "auto_multigrid")  # in "constant tolerances" and other tables
        parts = [row for row in found["rows"] if not row["label"].startswith(elsewhere)]
        for i, row in enumerate(parts):
            title = "**auto**" if row["label"] == "auto" else row["title"]
            title += _fewer_seeds(row, found["seeds"])
            costs = *_products(row), _saved(row), _seconds(row)
            body.append([f"{name}{seeds}" if i == 0 else "", title, error(row), *costs])
    return page_tables.markdown(["scene", "", "error", "forward", "adjoint", "in all", "saved", "s"], body)


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
    return page_tables.markdown(head, body)


def time_and_products():
    """What PRDP and auto save of the products, and of the time, at which error."""
    body = []
    for name in SCENES:
        found = rows(f"refinement_{name}")
        base, cells = found["converged"], []
        for row in (found["prdp"], found["auto"]):
            cells += [_products_saved(row, base), _time_saved(row, base), f"{row['metric'] / base['metric']:.2f}"]
        body.append([name, _seconds(base), *cells])
    of_each = ("products saved", "time saved", "error / converged")
    head = ["scene", "converged, s", *(f"{who}: {what}" for who in ("PRDP", "auto") for what in of_each)]
    return page_tables.markdown(head, body)


def constant_tolerances():
    """Errors and products of auto, of tuned PRDP and of one tolerance throughout."""
    body = []
    for name in _with_constant():
        found = rows(f"refinement_{name}")
        seeds = record(f"refinement_{name}")["seeds"]
        for i, row in enumerate([found["converged"], found["auto"], found["prdp"], *_constant(found)]):
            title = "**auto**" if row["label"] == "auto" else row["title"]
            title += _fewer_seeds(row, seeds)
            costs = _products(row)[2], _beside(row, found["auto"]), _saved(row)
            body.append([f"{name}, {seeds} seeds" if i == 0 < seeds - 1 else name if i == 0 else "", title])
            body[-1] += [error(row), *costs]
    return page_tables.markdown(["scene", "", "error", "products", "products / auto's", "saved"], body)


def the_best_constant():
    """The loosest tolerance that ends as converged solves do, beside auto; and what a wrong one costs."""
    body = []
    for name in _with_constant():
        found = rows(f"refinement_{name}")
        tolerances = _constant(found)
        good = [row for row in tolerances if row["as_good"]]
        best = min(good, key=lambda row: row["operator_applications"], default=None)
        of_best = ["none", "–"] if best is None else [_power_of(best), _beside(best, found["auto"])]
        loosest, tightest = tolerances[0], tolerances[-1]
        wrong = f"{loosest['metric'] / found['converged']['metric']:.2g}", _beside(tightest, found["auto"])
        wrong = (f"{what} with {_power_of(row)}" for what, row in zip(wrong, (loosest, tightest), strict=True))
        body.append([name, *of_best, *wrong])
    head = ["scene", "loosest that ends as converged", "products / auto's", "error of the loosest / converged"]
    return page_tables.markdown([*head, "products of the tightest / auto's"], body)


def _with_constant():
    """The scenes that were trained with constant tolerances."""
    return [name for name in SCENES if _constant(rows(f"refinement_{name}"))]


def _constant(found):
    return [row for label, row in found.items() if label.startswith("rtol_")]


def _beside(row, auto):
    return f"{row['operator_applications'] / auto['operator_applications']:.2f}"


def _power_of(row):
    return f"{float(row['label'].removeprefix('rtol_')):.0e}".replace("e-0", "e-")


# What takes the time of an update, as `prdp bench training` measured it. diffusion_inverse has no network.
TAKES_THE_TIME = {
    "burgers_2d": "solves",
    "diffusion_inverse": "solves",
    "heat_1d": "network",
    "heat_2d": "network",
    "burgers_1d": "network",
    "navier_stokes": "network",
}


def seconds():
    """The seconds of a training with each way of solving; of a row that fails or warns, only that it does."""
    body = []
    for name, what in TAKES_THE_TIME.items():
        found = rows(f"refinement_{name}")
        base, auto, prdp = (found[label] for label in ("converged", "auto", "prdp"))
        own = DOCS / "results" / f"{name}.json"
        exact = found.get("direct") or (rows(name).get("direct") if own.exists() else None)
        cells = [_seconds(base), _seconds(exact) if exact else "–", _seconds_claimed(auto), _seconds_claimed(prdp)]
        body.append([name, what, *cells, _time_saved(auto, base)])
    head = ["scene", "most of an update", "converged, s", "`Direct`, s", "auto, s", "PRDP, tuned, s", "auto saves"]
    return page_tables.markdown(head, body)


def _seconds_claimed(row):
    return _seconds(row) if row["as_good"] and not row["warnings"] else claim(row, 0.0)


def _products_saved(row, base):
    return claim(row, 1 - row["operator_applications"] / base["operator_applications"])


def comparison(name, seconds=True):
    """The rows of `prdp compare`, or of a record of `python -m benchmarks.refinement`."""
    body = []
    for row in record(name)["rows"]:
        title = f"**{row['title']}**" if row["label"] in BOLD else row["title"]
        title += _fewer_seeds(row, record(name)["seeds"])
        last = "–" if row["kind"] == "direct" else f"{row['last_k']:.3g}"
        body.append([title, error(row), last, *_products(row), _saved(row), *([_seconds(row)] if seconds else [])])
    head = ["", "error", "last K", "forward", "adjoint", "in all", "products saved", *(["s"] if seconds else [])]
    return page_tables.markdown(head, body)


def _saved(row):
    return "–" if row["kind"] in ("converged", "direct") else claim(row, row["products_saved"], 1)


def readme():
    """Converged, auto and PRDP of the scenes that train a network, or a field."""
    body = []
    for name in ("heat_1d", "burgers_1d", "burgers_2d", "heat_2d", "navier_stokes", "diffusion_inverse"):
        found = rows(f"refinement_{name}")
        base = found["converged"]
        body.append([f"{name}, {base['seeds']} seeds", "converged", error(base), "–", "–"])
        for label, title in (("auto", "**auto**"), ("prdp", "PRDP, tuned")):
            row = found[label]
            body.append(["", title, error(row), _products_saved(row, base), _time_saved(row, base)])
    return page_tables.markdown(["scene", "", "error", "products saved", "time saved"], body)


def _percent(share, digits=0):
    return f"{100 * share:.{digits}f} %".replace("-", "−")


# scene: its name and section in reproduction.md; the paper's share of iterations saved, and errors of the converged
# solver and of PRDP.
PAPER = {
    "heat_1d": ("[Heat 1D](#heat-1d-an-emulator)", "79 %", "2.1e-02 ± 3.9e-03", "2.1e-02 ± 3.8e-03"),
    "heat_2d": ("[Heat 2D](#heat-2d-and-3d-emulators)", "86 %", "1.4e-02 ± 8e-04", "1.1e-02 ± 6e-04"),
    "heat_3d": ("[Heat 3D](#heat-2d-and-3d-emulators)", "81 %", "4e-03 ± 9e-04", "5e-03 ± 1.0e-03"),
    "burgers_1d": ("[Burgers 1D](#burgers-1d-an-emulator)", "59 %", "5.5e-02 ± 1.4e-02", "6.2e-02 ± 2.1e-02"),
    "refinement_navier_stokes": (
        "[Navier–Stokes](#navier-stokes-a-corrector)",
        "81 %",
        "6e-03 ± 5e-04",
        "7e-03 ± 4e-04",
    ),
    "poisson_1p_implicit": ("[Poisson, one parameter](#poisson-one-parameter)", "33 %", "", ""),
    "poisson_3p_implicit": ("[Poisson, three parameters](#poisson-three-parameters)", "48 %", "", ""),
    "poisson_3p_sd_implicit": ("the same with steepest descent", "43 %", "", ""),
}


def beside_the_paper():
    """Of every scene that the paper has."""
    body = []
    for name, (title, saved, converged, prdp) in PAPER.items():
        base, ours = record(name)["rows"][0], rows(name)["prdp"]
        spent = (f"{row['budget']:,.0f}" for row in (base, ours))
        errors = error(base), converged, error(ours), prdp
        body.append([title, str(record(name)["seeds"]), *spent, claim(ours, ours["saved"], 1), saved, *errors])
    head = ["scene", "seeds", "iterations, converged", "PRDP", "saved", "paper"]
    return page_tables.markdown([*head, "error, converged", "paper", "error, PRDP", "paper"], body)


def three_parameters():
    """Poisson with three parameters: two solvers, two kinds of gradient."""
    body = []
    for name, title in (("poisson_3p", "Jacobi"), ("poisson_3p_sd", "steepest descent")):
        for backward in ("implicit", "unrolled"):
            found = rows(f"{name}_{backward}")
            base, prdp, auto, direct = (found[label] for label in ("converged", "prdp", "auto", "direct"))
            ours = error(prdp), f"{prdp['budget']:,.0f}", claim(prdp, prdp["saved"], 1)
            body.append(
                [f"{title}, {backward}", error(base), f"{base['budget']:,.0f}", *ours, error(auto), error(direct)]
            )
    head = ["", "converged: error", "iterations", "PRDP: error", "iterations", "saved", "auto: error", "direct: error"]
    return page_tables.markdown(head, body)


def what_a_warning_predicts():
    """How many rows end worse than converged ones, by how many of their seeds warn; each training counts once."""
    found = {}
    for path in sorted((DOCS / "results").glob("*.json")):
        scene = path.stem.removeprefix("refinement_").removesuffix("_implicit")
        for row in record(path.stem)["rows"]:
            if row["kind"] not in ("converged", "direct"):
                found.setdefault((scene, row["label"]), row)
    body = []
    for what, of_poisson in (("networks and fields", False), ("parameters of Poisson", True)):
        of_these = [row for (scene, _), row in found.items() if scene.startswith("poisson") == of_poisson]
        for which in ("all", "some", "none"):
            chosen = [row for row in of_these if _which_warn(row) == which]
            worse = sum(not row["as_good"] for row in chosen)
            if chosen:
                body.append([what, which, str(len(chosen)), str(worse), str(len(chosen) - worse)])
    return page_tables.markdown(["what is trained", "seeds that warn", "rows", "fail", "as good as converged"], body)


def _which_warn(row):
    """A training that diverged has no chance to warn."""
    if not row["warnings"]:
        return "none"
    return "all" if row["warnings"] + row["diverged"] == row["seeds"] else "some"


TABLES = {
    "what a warning predicts": what_a_warning_predicts,
    "the parts of auto": parts_of_auto,
    "the shares of auto": shares_of_auto,
    "the README's table": readme,
    "the scenes beside the paper": beside_the_paper,
    "three parameters": three_parameters,
    "time and products": time_and_products,
    "seconds": seconds,
    "constant tolerances": constant_tolerances,
    "the best constant": the_best_constant,
}


def study(name):
    """The table that the study itself makes."""
    module = importlib.import_module(f"benchmarks.studies.{name}")
    return module.table(record(f"studies/{name}")["rows"]) + "\n"


def table(name):
    kind, _, what = name.partition(" of ")
    if kind == "the comparison":
        return comparison(what)
    if kind == "the comparison, without seconds,":
        return comparison(what, seconds=False)
    if kind == "the study":
        return study(what)
    return TABLES[name]()


def with_tables(page):
    """Return the text of a page with its tables written anew."""
    return page_tables.with_tables(page, "result_tables.py", table)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(with_tables(path.read_text()))
