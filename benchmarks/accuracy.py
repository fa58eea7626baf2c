"""Residual and gradient error against time and products: every solver and mode, K along the curve, and
other libraries. Each run is checked before it is timed."""

from benchmarks import measure, ours, peers
from benchmarks.problems import PROBLEMS

# How far the errors of the same truncated iteration may be apart, relative: float32, other roundings.
SAME = 0.3
ROUNDING = 1e-6  # and below this they are rounding errors


def run(report, quick=False):
    """{problem: {"points": one a solver and K, "failures": peers that failed, with their error}}."""
    return {name: problem_points(make(), report, quick) for name, make in PROBLEMS.items()}


def problem_points(problem, report, quick):
    found, failures, calls = [], {}, {}
    for entry in [*ours.entries(problem), *peers.entries(problem)]:
        for k in entry.ks[-1:] if quick else entry.ks:
            report(f"{problem.title}: {entry.label}, {entry.mode}" + ("" if k is None else f", K = {k}"))
            try:
                forward, both = entry.prepare(k)
                found.append(checked(problem, entry, k, *both()))
            except Exception as error:
                if entry.applications is not None:
                    raise
                failures[entry.label] = str(error).strip().splitlines()[0]
                continue
            calls[len(found) - 1, "forward"], calls[len(found) - 1, "both"] = forward, both
    report(f"{problem.title}: timing {len(calls)} calls in turn")
    times = measure.interleaved(calls, rounds=3 if quick else measure.ROUNDS)
    for (number, which), seconds in times.items():
        found[number][f"{which}_seconds"] = seconds
    return {"points": found, "failures": failures}


def checked(problem, entry, k, u, gradient):
    """The point without its times. RuntimeError where a peer's answer is not the one it should be."""
    residual, gradient_error = problem.errors(u, gradient)
    point = {"label": entry.label, "mode": entry.mode, "k": k, "residual": residual, "gradient_error": gradient_error,
             "ours": entry.applications is not None}  # fmt: skip
    if entry.applications is not None:
        point["forward_products"], point["both_products"] = entry.applications(k)
    elif entry.same_as is not None:
        solver, _ = ours.methods(problem)[entry.same_as]
        mine = problem.errors(*ours.calls(problem, solver(k), "implicit")[1]())
        if any(abs(a - b) > SAME * max(b, ROUNDING) for a, b in zip((residual, gradient_error), mine, strict=True)):
            raise RuntimeError(f"{entry.label}: errors {residual:.2e} and {gradient_error:.2e}, ours {mine}")
    elif not residual < 1e-3:
        raise RuntimeError(f"{entry.label}: relative residual {residual:.2e} on {problem.title}")
    return point
