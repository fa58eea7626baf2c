"""Write the tables of results on the pages of docs from the records in docs/results.

A row that ends worse than the converged one, or whose controller warns, claims no saving in any of them.
Run it after new records: python -m docs.result_tables
"""

import importlib
import re

from docs import baseline_tables, page_tables
from docs.baseline_tables import SCENES
from docs.record_rows import (
    DOCS,
    claim,
    error,
    fewer_seeds,
    of_scene,
    products,
    products_saved,
    record,
    rows,
    saved,
    seconds,
    seconds_beside,
    time_saved,
    title,
)

TABLE = page_tables.places("result_tables.py")
PAGES = [path for path in sorted(DOCS.rglob("*.md")) if TABLE.search(path.read_text())]

BOLD = ("auto", "prdp")


def parts_of_auto():
    """Converged, PRDP and the parts of auto, of every scene."""
    body = []
    for name in SCENES:
        found = record(f"refinement_{name}")
        seeds = found["seeds"]
        elsewhere = ("rtol_", "direct", "multigrid", "auto_multigrid")  # in "constant tolerances" and other tables
        parts = [row for row in found["rows"] if not row["label"].startswith(elsewhere)]
        for i, row in enumerate(parts):
            costs = *products(row), saved(row), seconds(row)
            body.append(["" if i else of_scene(name, seeds), title(row, seeds), error(row), *costs])
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
            cells += [products_saved(row, base), time_saved(row, base), f"{row['metric'] / base['metric']:.2f}"]
        body.append([name, seconds(base), *cells])
    of_each = ("products saved", "time saved", "error / converged")
    head = ["scene", "converged, s", *(f"{who}: {what}" for who in ("PRDP", "auto") for what in of_each)]
    return page_tables.markdown(head, body)


def comparison(name, with_seconds=True):
    """The rows of `prdp compare`, or of a record of `python -m benchmarks.refinement`."""
    body, found = [], record(name)
    for row in found["rows"]:
        last = "–" if row["kind"] == "direct" else f"{row['last_k']:.3g}"
        time = [seconds_beside(row, found)] if with_seconds else []
        body.append([_name(row, found["seeds"]), error(row), last, *products(row), saved(row), *time])
    head = ["", "error", "last K", "forward", "adjoint", "in all", "products saved", *(["s"] if with_seconds else [])]
    return page_tables.markdown(head, body)


def _name(row, seeds):
    name = "auto" if row["label"] == "auto" else row["title"]
    return (f"**{name}**" if row["label"] in BOLD else name) + fewer_seeds(row, seeds)


PARTS = ("prdp_defaults", "prdp_growth", "tolerance", "tolerance_adjoint", "rtol_0.0001")
# Rows that the text of a page does not speak of. The appendix has them.
IN_APPENDIX = {
    "heat_2d": ("constant_2", "constant_20"),
    "refinement_navier_stokes": ("rtol_0.1",),
    "refinement_diffusion_inverse": ("rtol_0.1",),
}


def main_rows(name, with_seconds=True):
    """A comparison without the parts of a rule, and without the products of each kind."""
    body, found = [], record(name)
    left_out = PARTS + IN_APPENDIX.get(name, ())
    for row in found["rows"]:
        if row["label"] not in left_out:
            time = [seconds_beside(row, found)] if with_seconds else []
            body.append([_name(row, found["seeds"]), error(row), products(row)[2], saved(row), *time])
    return page_tables.markdown(["", "error", "products", "saved", *(["s"] if with_seconds else [])], body)


# scene: its name and section in reproduction.md; the paper's share of iterations saved, and errors of the converged
# solver and of PRDP.
PAPER = {
    "heat_1d": ("[Heat 1D](#heat-1d-an-emulator)", "79 %", "2.1e-02 ± 3.9e-03", "2.1e-02 ± 3.8e-03"),
    "heat_2d": ("[Heat 2D](#heat-2d-and-3d-emulators)", "86 %", "1.4e-02 ± 8e-04", "1.1e-02 ± 6e-04"),
    "heat_3d": ("[Heat 3D](#heat-2d-and-3d-emulators)", "81 %", "4e-03 ± 9e-04", "5e-03 ± 1.0e-03"),
    "burgers_1d": ("[Burgers 1D](#burgers-1d-an-emulator)", "59 %", "5.5e-02 ± 1.4e-02", "6.2e-02 ± 2.1e-02"),
    "refinement_navier_stokes": (
        "[Navier–Stokes](#navierstokes-a-corrector)",
        "81 %",
        "6e-03 ± 5e-04",
        "7e-03 ± 4e-04",
    ),
    "poisson_1p_implicit": ("[Poisson, one parameter](#poisson-one-parameter)", "33 %", "", ""),
    "poisson_3p_implicit": ("[Poisson, three parameters](#poisson-three-parameters)", "48 %", "", ""),
    "poisson_3p_sd_implicit": ("the same with steepest descent", "43 %", "", ""),
}

PARTS_OF_THE_PAPER = {
    "heat_1d": "60 + 19 %",
    "heat_2d": "72 + 14 %",
    "burgers_1d": "30 + 29 %",
    "refinement_navier_stokes": "65 + 16 %",
}


def beside_the_paper():
    """Of every scene that the paper has."""
    body = []
    for name, (scene, theirs, converged, prdp) in PAPER.items():
        base, ours = record(name)["rows"][0], rows(name)["prdp"]
        spent = (f"{row['budget']:,.0f}" for row in (base, ours))
        errors = error(base), converged, error(ours), prdp
        body.append([scene, *spent, claim(ours, ours["saved"], 1), theirs, *errors])
    head = ["scene", "iterations, converged", "iterations, PRDP", "saved", "paper saves"]
    head += ["error, converged", "paper's", "error, PRDP", "paper's"]
    return page_tables.markdown(head, body)


def parts_of_the_saving():
    """Iterations saved by stopping below full convergence, and by starting with few."""
    body = []
    for name, (scene, *_) in PAPER.items():
        row = rows(name)["prdp"]
        incomplete, whole = row["saved_by_incomplete_convergence"], row["saved"]
        ours = [claim(row, share, 1) for share in (incomplete, whole - incomplete)]
        link = scene.replace("](#", "](../reproduction.md#")  # the table is in the appendix
        body.append([link, *ours, PARTS_OF_THE_PAPER.get(name, "")])
    head = ["scene", "incomplete convergence", "progressive refinement", "paper"]
    return page_tables.markdown(head, body)


def three_parameters():
    """Poisson with three parameters: two solvers, two kinds of gradient."""
    body = []
    for name, solver in (("poisson_3p", "Jacobi"), ("poisson_3p_sd", "steepest descent")):
        for backward in ("implicit", "unrolled"):
            found = rows(f"{name}_{backward}")
            base, prdp, auto, direct = (found[label] for label in ("converged", "prdp", "auto", "direct"))
            ours = error(prdp), f"{prdp['budget']:,.0f}", claim(prdp, prdp["saved"], 1)
            body.append(
                [f"{solver}, {backward}", error(base), f"{base['budget']:,.0f}", *ours, error(auto), error(direct)]
            )
    head = ["", "converged: error", "iterations", "PRDP: error", "iterations", "saved", "auto: error", "direct: error"]
    return page_tables.markdown(head, body)


def _ways_of_choosing():
    """The rows of all scenes, each training once, by scene and label."""
    found = {}
    for path in sorted((DOCS / "results").glob("*.json")):
        scene = path.stem.removeprefix("refinement_").removesuffix("_implicit")
        for row in record(path.stem)["rows"]:
            if row["kind"] not in ("converged", "direct"):
                found.setdefault((scene, row["label"]), row)
    return found


def residuals_of_warnings():
    """What the first seed to warn said of its solves, over the limit's e / (1 + e), smallest first."""
    body = []
    for (scene, _), row in _ways_of_choosing().items():
        said = re.search(r"residual of (\S+) .* error of (\S+):", row["warning"] or "")
        if said and not scene.startswith("poisson"):
            residual, error_of_state = map(float, said.groups())
            share = residual / (error_of_state / (1 + error_of_state))
            ends = "as converged" if row["as_good"] else "fails"
            body.append([f"{share:.2f}", scene, row["title"], said[1], said[2], f"{_which_warn(row)} warn", ends])
    head = ["residual over e / (1 + e)", "scene", "", "residual", "e", "seeds", "ends"]
    return page_tables.markdown(head, sorted(body, key=lambda cells: float(cells[0])))


def what_a_warning_predicts():
    """How many rows end worse than converged ones, by how many of their seeds warn; each training counts once."""
    found, body = _ways_of_choosing(), []
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
    "the residuals of warnings": residuals_of_warnings,
    "what a warning predicts": what_a_warning_predicts,
    "the parts of auto": parts_of_auto,
    "the shares of auto": shares_of_auto,
    "the scenes beside the paper": beside_the_paper,
    "the parts of the saving": parts_of_the_saving,
    "three parameters": three_parameters,
    "time and products": time_and_products,
    "the seconds of Burgers 2D": baseline_tables.burgers_2d,
    "seconds": baseline_tables.seconds,
    "constant tolerances": baseline_tables.constant_tolerances,
    "the best constant": baseline_tables.the_best_constant,
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
        return comparison(what, with_seconds=False)
    if kind == "the main rows":
        return main_rows(what)
    if kind == "the main rows, without seconds,":
        return main_rows(what, with_seconds=False)
    if kind == "the study":
        return study(what)
    return TABLES[name]()


def with_tables(page):
    """Return the text of a page with its tables written anew."""
    return page_tables.with_tables(page, "result_tables.py", table)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(with_tables(path.read_text()))
