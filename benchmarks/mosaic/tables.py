"""The tables of the tasks, written from the rows of their records."""

from benchmarks.mosaic import solvers
from docs import page_tables


def of(task, rows):
    """{title: markdown table} of what the rows hold; the last one lists who cannot run the task, and why."""
    found = {title: table for title, table in TABLES[task](rows).items() if table}
    reasons = missing(task, rows)
    return {**found, f"{task}: not run": reasons} if reasons else found


def grid(rows, columns, cell, family=solvers.FLOWS):
    """One row per solver, one column per case; `columns` is {title: case}, `cell(result)` the text."""
    asked = {name: [_cell(rows, name, case, cell) for case in columns.values()] for name in family}
    body = [[family[name].label, *cells] for name, cells in asked.items() if any(c not in ("", "–") for c in cells)]
    return page_tables.markdown(["", *columns], body) if body else ""


def _cell(rows, solver, case, cell):
    for row in rows:
        if row["solver"] == solver and row["case"] == case:
            return cell(row["result"]) if "result" in row else "failed" if "failed" in row else "–"
    return ""


def cases(rows, **wanted):
    """The cases of the record that agree with `wanted`, in its order."""
    found = []
    for row in rows:
        case = row["case"]
        if case not in found and all(case.get(key) == value for key, value in wanted.items()):
            found.append(case)
    return found


def missing(task, rows):
    """A table of solver, case and reason, for whatever has no result. Equal reasons are said once."""
    family = solvers.CONDUCTION if task == "conduction" else solvers.FLOWS
    reasons = {}
    for row in rows:
        for key in ("cannot", "unavailable", "failed"):
            if key in row:
                case = "" if key != "failed" else ", ".join(f"{name} {value}" for name, value in row["case"].items())
                reasons.setdefault((row["solver"], row[key]), []).append(case)
    body = [[family[name].label, "; ".join(filter(None, of_reason)), reason]
            for (name, reason), of_reason in reasons.items()]  # fmt: skip
    return page_tables.markdown(["", "case", "reason"], body) if body else ""


def _number(x):
    return "–" if x is None else f"{x:.1e}"


def seconds(x):
    return f"{x:.2g} s" if x < 10 else f"{x:,.0f} s"


def megabytes(x):
    return f"{x / 1e6:.1f} MB" if x < 1e7 else f"{x / 1e6:,.0f} MB"


def forward(rows):
    found = {}
    for field in dict.fromkeys(row["case"]["field"] for row in rows):
        of_field = cases(rows, field=field)
        columns = {_settings(case): case for case in of_field}
        found[f"forward, {field}: error"] = grid(rows, columns, lambda r: _number(r["error"]))
        found[f"forward, {field}: divergence"] = grid(rows, columns, lambda r: _number(r["divergence"]))
        found[f"forward, {field}: energy"] = grid(rows, columns, lambda r: f"{r['energy']:.5f}")
    return found


def _settings(case):
    return f"N = {case['n']}, ν = {case['nu']:g}, dt = {case['dt']:g}, {case['steps']} steps"


def cost(rows):
    found = {}
    for dim in (2, 3):
        of_dim = cases(rows, dim=dim)
        columns = {f"N = {case['n']}, {case['steps']} steps": case for case in of_dim}
        for part, title in (("forward", "forward"), ("gradient", "forward and gradient")):
            found[f"cost, {dim}D: seconds, {title}"] = grid(rows, columns, lambda r, p=part: seconds(r[f"{p}_seconds"]))
            found[f"cost, {dim}D: memory, {title}"] = grid(rows, columns, lambda r, p=part: megabytes(r[f"{p}_bytes"]))
        found[f"cost, {dim}D: seconds to compile"] = grid(
            rows, columns, lambda r: seconds(r["forward_compile_seconds"] + r["gradient_compile_seconds"])
        )
    return found


def gradient(rows):
    def cell(result):
        return f"{_number(result['median_error'])} ({result['cosine']:.6f})" if result["finite"] else "not finite"

    return {
        f"gradient, {dim}D: median error (cosine)": grid(
            rows, {f"{case['steps']} steps": case for case in cases(rows, dim=dim)}, cell
        )
        for dim in (2, 3)
    }


def horizon(rows):
    """The largest number of steps up to which every gradient was finite."""
    body = []
    for name, entry in solvers.FLOWS.items():
        longest = []
        for dim in (2, 3):
            tried = {row["case"]["steps"]: row.get("result", {}).get("finite", False) for row in rows
                     if row["solver"] == name and row["case"]["dim"] == dim and "unavailable" not in row}  # fmt: skip
            reached = [steps for steps in sorted(tried) if all(tried[s] for s in tried if s <= steps)]
            longest.append("" if not tried else f"{reached[-1]:,}" if reached else f"fewer than {min(tried):,}")
        if any(longest):
            body.append([entry.label, *longest])
    return {"horizon: steps": page_tables.markdown(["", "2D", "3D"], body) if body else ""}


def design(rows):
    columns = {f"N = {case['n']}, {case['iterations']} iterations": case for case in cases(rows)}
    return {"design: drag": grid(rows, columns, lambda r: f"{r['drags'][0]:.4f}, at last {r['drags'][-1]:.4f}")}


def recovery(rows):
    columns = {f"N = {case['n']}, seed {case['seed']}": case for case in cases(rows)}
    return {
        "recovery: relative error of the initial state (final loss)": grid(
            rows, columns, lambda r: f"{_number(r['error'])} ({_number(r['losses'][-1])})"
        )
    }


def conduction(rows):
    def columns(what):
        return {f"{case['nx']} × {case['nx'] // 2}": case for case in cases(rows, what=what)}

    def table(what, cell):
        return grid(rows, columns(what), cell, solvers.CONDUCTION)

    return {
        "conduction: error of the compliance, uniform, layered": table(
            "exact", lambda r: f"{_number(r['uniform'])}, {_number(r['layered'])}"
        ),
        "conduction: median error of the gradient (cosine)": table(
            "gradient", lambda r: f"{_number(r['median_error'])} ({r['cosine']:.6f})"
        ),
        "conduction: seconds, forward (with gradient)": table(
            "cost", lambda r: f"{seconds(r['forward_seconds'])} ({seconds(r['gradient_seconds'])})"
        ),
        "conduction: memory, forward (with gradient)": table(
            "cost", lambda r: f"{megabytes(r['forward_bytes'])} ({megabytes(r['gradient_bytes'])})"
        ),
        "conduction: error of the recovered density (final loss)": table(
            "recovery", lambda r: f"{_number(r['error'])} ({_number(r['losses'][-1])})"
        ),
    }


TABLES = {"forward": forward, "cost": cost, "gradient": gradient, "horizon": horizon, "design": design,
          "recovery": recovery, "conduction": conduction}  # fmt: skip
