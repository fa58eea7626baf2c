"""Auto beside what a user could take instead: the strongest converged solver, and one tolerance throughout."""

from docs import page_tables
from docs.record_rows import (
    by_label,
    claim,
    claims,
    error,
    median_seconds,
    of_scene,
    power,
    products,
    record,
    rows,
    saved,
    shown,
    time_saved,
    title,
)
from docs.record_rows import seconds as seconds_of

SCENES = ("poisson_1p", "poisson_3p", "poisson_3p_sd", "heat_1d", "heat_2d", "burgers_1d", "burgers_2d")
SCENES = (*SCENES, "navier_stokes", "diffusion_inverse")
TOO_SHORT = 0.5  # seconds of a training; what is shorter is all noise
# The scene's solver, and what takes the time of an update, as `python -m benchmarks training` measured it.
# diffusion_inverse has no network.
GROUPS = {
    "solves": "the solves take the time",
    "both": "solves and network take it",
    "network": "the network takes it",
}
TRAININGS = {
    "burgers_2d": ("GMRES(6)", "solves"),
    "burgers_2d_192": ("GMRES(6)", "solves"),
    "diffusion_inverse": ("CG", "solves"),
    "diffusion_inverse_256": ("CG", "solves"),
    "kolmogorov": ("CG with multigrid", "both"),
    "heat_1d": ("Jacobi", "network"),
    "heat_2d": ("Jacobi", "network"),
    "burgers_1d": ("GMRES(2)", "network"),
    "navier_stokes": ("GMRES(8)", "network"),
}


def seconds():
    """The seconds of a training with each way of solving; of a row that fails or warns, only that it does."""
    body, group = [], None
    for name, (solver, what) in TRAININGS.items():
        if what != group:
            body.append([f"**{GROUPS[what]}**", *[""] * 7])
            group = what
        found = rows(f"refinement_{name}")
        base, prdp = found["converged"], found.get("prdp")
        others = _of_as_many_seeds(found.values(), base)
        strongest = _fastest(row for row in others if row["label"] in ("converged", "direct", "multigrid"))
        auto = _fastest(row for row in others if row["label"] in ("auto", "auto_multigrid"))
        constant = _fastest(filter(None, (_loosest(others), _loosest(others, "multigrid_"))))
        seeds = "" if base["seeds"] > 1 else ", one seed"
        cells = [
            seconds_of(base),
            _with_notes(strongest, _other_solver(strongest), _range(strongest)),
            _with_notes(constant, _power_of(constant), _other_solver(constant)),
            _seconds_claimed(prdp if prdp in others else None),
            _with_notes(auto, _other_solver(auto), _range(auto)),
        ]
        ends = f"{auto['metric'] / base['metric']:.2f}"
        body.append([f"{name}, {solver}{seeds}", *cells, time_saved(auto, strongest), ends])
    return page_tables.markdown(["", "converged", "strongest", "one rtol", "PRDP", "auto", "auto saves", "error"], body)


def _range(row):
    """The least and the greatest seconds of the seeds."""
    each = row.get("each", {}).get("seconds")
    return "–".join(shown(value) for value in (min(each), max(each))) if each and len(each) > 1 else None


SOLVERS = {  # of Burgers 2D
    "converged": "converged, GMRES(6)",
    "multigrid": "converged, multigrid",
    "rtol_0.1": "rtol = 1e-1 throughout, GMRES(6)",
    "rtol_0.01": "rtol = 1e-2 throughout, GMRES(6)",
    "multigrid_rtol_0.01": "rtol = 1e-2 throughout, multigrid",
    "prdp": "PRDP, tuned, GMRES(6)",
    "auto": "**auto**, GMRES(6)",
    "auto_multigrid": "**auto**, multigrid",
}


def burgers_2d():
    """The seconds and the errors of Burgers 2D on two grids."""
    grids = [rows(f"refinement_{name}") for name in ("burgers_2d", "burgers_2d_192")]
    body = []
    for label, how in SOLVERS.items():
        if any(label in found for found in grids):
            body.append([how, *(cell for found in grids for cell in _seconds_and_error(found.get(label)))])
    return page_tables.markdown(["", "96²: s", "error", "192²: s", "error"], body)


def _seconds_and_error(row):
    return _seconds_claimed(row), "–" if row is None else f"{row['metric']:.3f}"


def _of_as_many_seeds(found, base):
    """Rows of fewer seeds are older, and of another machine."""
    return [row for row in found if row["seeds"] == base["seeds"]]


def _fastest(found):
    return min(filter(claims, found), key=median_seconds)


def _other_solver(row):
    """The solver, where it is not that of the scene."""
    return "`Direct`" if row["label"] == "direct" else "multigrid" if "multigrid" in row["label"] else None


def _with_notes(row, *notes):
    said = ", ".join(filter(None, notes))
    return f"{seconds_of(row)} ({said})" if said else seconds_of(row)


def _seconds_claimed(row):
    if row is None:
        return "–"
    return seconds_of(row) if claims(row) else claim(row, 0.0)


def constant_tolerances():
    """Errors and products of auto, of tuned PRDP and of one tolerance throughout."""
    body = []
    for name in SCENES:
        whole = record(f"refinement_{name}")
        found, seeds = by_label(whole), whole["seeds"]
        for i, row in enumerate([found["converged"], found["auto"], found["prdp"], *_constant(found.values())]):
            costs = products(row)[2], _beside(row, found["auto"]), saved(row)
            body.append(["" if i else of_scene(name, seeds), title(row, seeds), error(row), *costs])
    return page_tables.markdown(["scene", "", "error", "products", "products / auto's", "saved"], body)


def the_best_constant():
    """The loosest tolerance that ends as converged solves do, without a warning, beside auto; and what a wrong one
    costs."""
    body = []
    for name in (*SCENES, "kolmogorov"):
        whole = record(f"refinement_{name}")
        found, last = by_label(whole), power(whole["curves"]["auto"]["rtol"][-1])
        auto, tolerances = found["auto"], _constant(found.values())
        best, loosest, tightest = _loosest(tolerances), tolerances[0], tolerances[-1]
        wrong = f"{loosest['metric'] / found['converged']['metric']:.2g} with {_power_of(loosest)}"
        time = f"{median_seconds(best) / median_seconds(auto):.2f}" if median_seconds(auto) > TOO_SHORT else "–"
        spent = f"{_beside(tightest, auto)} with {_power_of(tightest)}"
        body.append([name, _power_of(best), _beside(best, auto), time, last, wrong, spent])
    head = ["scene", "best constant", "its products / auto's", "its seconds / auto's", "auto's last rtol"]
    head += ["error of the loosest / converged", "products of the tightest / auto's"]
    return page_tables.markdown(head, body)


def _constant(found, solver=""):
    return [row for row in found if row["label"].startswith(f"{solver}rtol_")]


def _loosest(found, solver=""):
    """Of the constant tolerances that end as converged solves do, without a warning."""
    return min(filter(claims, _constant(found, solver)), key=lambda row: row["operator_applications"], default=None)


def _beside(row, auto):
    return f"{row['operator_applications'] / auto['operator_applications']:.2f}"


def _power_of(row):
    return power(float(row["label"].rpartition("_")[2]))
