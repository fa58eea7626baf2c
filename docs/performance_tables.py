"""Write the tables of docs/performance.md and docs/appendix/performance.md from the records in docs/performance.

Run it after new records: python -m docs.performance_tables
"""

import json
from pathlib import Path
from statistics import median

from docs import page_tables

DOCS = Path(__file__).parent
PAGES = [DOCS / "performance.md", DOCS / "appendix" / "performance.md"]
TABLE = page_tables.places("performance_tables.py")


def record(suite):
    return json.loads((DOCS / "performance" / f"{suite}.json").read_text())[suite]


def _short(x):
    """Two digits, or all before the point."""
    return f"{x:.2g}" if x < 10 else f"{x:,.0f}"


def _both(point):
    """The time of a solve with its implicit gradient; in brackets, of the solve alone."""
    both, forward = (point[name]["min"] for name in ("both_seconds", "forward_seconds"))
    return f"{_short(1e3 * both)} ({_short(1e3 * forward)})"


# The rows: suite, title, our method, K; the other libraries' method and K.
ACCURACY = [
    ("heat_1d", "heat 1D, Jacobi, K = 25", "Jacobi", 25, "Jacobi", 25),
    ("heat_2d", "heat 2D, Jacobi, K = 43", "Jacobi", 43, "Jacobi", 43),
    ("heat_3d", "heat 3D, Jacobi, K = 50", "Jacobi", 50, "Jacobi", 50),
    ("heat_3d", "heat 3D, Chebyshev, K = 25", "Chebyshev", 25, "Jacobi", 50),
    ("burgers_1d", "Burgers, GMRES(2), K = 23", "GMRES(2)", 23, "GMRES(2)", 23),
    ("navier_stokes", "Navier–Stokes, GMRES(8), K = 15", "GMRES(8)", 15, "GMRES(8)", 15),
]


def beside_others():
    """Our time, and the times of others as multiples of it."""
    found, body = record("accuracy"), []
    for suite, title, method, k, theirs, their_k in ACCURACY:
        points = {(p["label"], p["k"]): p for p in found[suite]["points"] if p["mode"] == "implicit"}
        ours = points[method, k]
        errors = f"{ours['residual']:.1e}", f"{ours['gradient_error']:.1e}"
        others = [
            _ratio(points.get((f"{peer}, {theirs}", their_k)), ours)
            for peer in ("torch eager", "torch.compile", "JAX jit")
        ]
        body.append([title, *errors, _both(ours), *others])
    head = ["", "residual", "gradient error", "ours, ms", "torch eager", "torch.compile", "JAX jit"]
    return page_tables.markdown(head, body)


def _ratio(theirs, ours):
    if theirs is None:
        return "–"
    both, forward = (theirs[name]["min"] / ours[name]["min"] for name in ("both_seconds", "forward_seconds"))
    return f"{_short(both)} ({_short(forward)})"


# The rows of variable diffusion: title, label of the record; K is that of the iterative ones.
DIFFUSION = [
    ("**CG on `Stencil`**", "CG"),
    ("CG, diagonal", "CG, diagonal"),
    ("`Direct` (sparse Cholesky)", "direct"),
    ("CG on `Function`", "CG, Function"),
    ("torch eager, CG", "torch eager, CG"),
    ("torch.compile, CG", "torch.compile, CG"),
    ("JAX jit, CG", "JAX jit, CG"),
    ("lineax, CG", "lineax, CG"),
    ("SciPy, sparse LU", "SciPy, sparse LU"),
]


def diffusion():
    found = record("diffusion")
    body = [[title, *_on("diffusion_64", 40, label, found), *_on("diffusion_256", 150, label, found)]
            for title, label in DIFFUSION]  # fmt: skip
    head = ["", "64², K = 40", "residual", "gradient error", "256², K = 150", "residual", "gradient error"]
    return page_tables.markdown(head, body)


def _on(grid, k, label, found):
    for point in found[grid]["points"]:
        asked = point["k"] == k or label in ("direct", "lineax, CG", "SciPy, sparse LU")  # which choose their own
        if point["label"] == label and point["mode"] == "implicit" and asked:
            return _both(point), f"{point['residual']:.1e}", f"{point['gradient_error']:.1e}"
    return "failed" if label in found[grid]["failures"] else "–", "", ""


CASES = {
    "heat_3d": "heat 3D 20³, Jacobi",
    "heat_3d_chebyshev": "heat 3D 20³, Chebyshev",
}
MODES = {
    "unrolled, checkpoint_every='sqrt'": '`checkpoint_every="sqrt"`',
    "unrolled, recorded by autograd": "recorded by autograd (`create_graph=True`)",
}


def memory():
    """Peak resident memory that a solve with its gradients adds, in MB."""
    found = record("memory")
    budgets = sorted({point["k"] for point in found})
    body = []
    for case in CASES:
        for mode in dict.fromkeys(point["mode"] for point in found):
            title = f"**{CASES[case]}**: {mode}" if mode == "implicit" else MODES.get(mode, mode)
            of_k = {p["k"]: p["bytes"] for p in found if (p["case"], p["mode"]) == (case, mode)}
            body.append([title, *(_short(of_k[k] / 1e6) for k in budgets)])
    return page_tables.markdown(["", *(f"K = {k}" for k in budgets)], body)


PROBLEMS = {
    "heat_1d": "heat 1D",
    "heat_2d": "heat 2D",
    "heat_3d": "heat 3D",
    "burgers_1d": "Burgers",
    "navier_stokes": "Navier–Stokes",
}


def threads():
    """How many times as fast two threads are as one."""
    found = record("calls")["threads"]
    body = []
    for batch in dict.fromkeys(row["batch"] for row in found):
        of_problem = {row["problem"]: row["one"] / row["two"] for row in found if row["batch"] == batch}
        body.append([str(batch), *(f"{of_problem[name]:.1f}" for name in PROBLEMS)])
    return page_tables.markdown(["batch", *PROBLEMS.values()], body)


COMPARED = {"ours": "", "torch.compile": "torch.compile", "JAX": "JAX jit,", "JAX, K traced": "JAX jit with K traced"}


def change_of_k():
    """The median of the calls with a new K, the first of each and the one after it."""
    found, body = record("change_of_k"), []
    labels = list(dict.fromkeys(row["label"] for row in found))
    columns = {who: begins for who, begins in COMPARED.items() if any(label.startswith(begins) for label in labels)}
    for problem in dict.fromkeys(row["problem"] for row in found):
        cells = []
        for begins in columns.values():
            of_problem = [row for row in found if row["problem"] == problem and row["label"].startswith(begins)]
            calls = [row for row in of_problem if row["label"] == of_problem[0]["label"]][1:]  # the first one warms up
            for which in ("first_seconds", "later_seconds"):
                cells.append(_with_unit(median(row[which] for row in calls)) if calls else "–")
        body.append([problem, *cells])
    head = ["", *(f"{who}: {what}" for who in columns for what in ("first call", "later"))]
    return page_tables.markdown(head, body)


def _with_unit(seconds):
    unit, factor = next(((u, f) for u, f in (("s", 1.0), ("ms", 1e3)) if seconds * f >= 1.0), ("µs", 1e6))
    return f"{_short(seconds * factor)} {unit}"


def large(power="²"):
    """Seconds of a first solve, and of one more in brackets, on each grid; the residual on the largest."""
    found = [point for point in record("large") if point["grid"].endswith(power)]
    grids = list(dict.fromkeys(point["grid"] for point in found))
    body = []
    for solver in dict.fromkeys(point["solver"] for point in found):
        of_grid = {point["grid"]: point for point in found if point["solver"] == solver}
        times = [
            f"{_short(of_grid[n]['seconds'])} ({_short(of_grid[n]['again'])})" if n in of_grid else "–" for n in grids
        ]
        last = of_grid.get(grids[-1])
        body.append([solver, *times, f"{last['residual']:.1e}" if last else "–"])
    return page_tables.markdown(["", *grids, f"residual at {grids[-1]}"], body)


TABLES = {
    "change of K": change_of_k,
    "large grids": large,
    "cubes": lambda: large("³"),
    "other libraries": beside_others,
    "diffusion": diffusion,
    "memory": memory,
    "threads": threads,
}


def table(what):
    return TABLES[what]()


def with_tables(page):
    """Return the text of the page with its tables written anew."""
    return page_tables.with_tables(page, "performance_tables.py", table)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(with_tables(path.read_text()))
