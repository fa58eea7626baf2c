"""One HTML page of all that was measured, its pictures beside it as PNG."""

import base64
import io
from pathlib import Path

import jinja2

from benchmarks import charts, memory
from benchmarks.problems import DIFFUSION, PROBLEMS
from prdp_torch.experiments import records
from prdp_torch.experiments.charts import write_png


def write(results, environment, folder):
    """`page.html` and PNG files, from {suite: what it found}."""
    parts = list(sections(results))
    for part in parts:
        write_png(part["figure"], folder / f"{part['name']}.png", dpi=130)
        svg = io.BytesIO()
        part["figure"].savefig(svg, format="svg")
        part["svg"] = base64.b64encode(svg.getvalue()).decode()
    template = jinja2.Template(Path(__file__).with_name("page.html.j2").read_text(), autoescape=True)
    records.write(folder / "page.html", template.render(sections=parts, environment=environment))


def sections(results):
    for name, found in (results.get("accuracy", {}) | results.get("diffusion", {})).items():
        title, points = (PROBLEMS | DIFFUSION)[name]().title, found["points"]
        failed = "".join(f" {label} failed: {error}." for label, error in found["failures"].items())
        yield {
            "name": f"accuracy_{name}", "title": f"{title}: accuracy against cost",
            "text": "Batch of 25, float32. A curve is a solver with growing K, a large hollow mark another library or "
            "an exact method. Lower left is better. Errors are measured in float64, the gradient's against the exact "
            "one." + failed,
            "figure": charts.accuracy(title, points), "table": accuracy_table(points),
        }  # fmt: skip
    if "size" in results:
        yield {
            "name": "size", "title": "Cost against size", "figure": charts.size(results["size"]), "table": None,
            "text": "Flat is right. Left: dotted lines mark where three vectors of a sample fill a cache; small "
            "samples pay for the call. Right: samples are independent, so the time per unknown falls to its level.",
        }  # fmt: skip
    if "large" in results:
        yield {
            "name": "large", "title": "Large grids", "figure": charts.large(results["large"]),
            "table": large_table(results["large"]),
            "text": "-∇·(κ ∇u) = b, κ smooth with a contrast of 800, one sample, rtol 1e-5. Ours in float32; others "
            "in float64, from an assembled matrix, whose assembly is not counted.",
        }  # fmt: skip
    if "roofline" in results:
        yield {
            "name": "roofline", "title": "Reached, against the limits of this machine",
            "figure": charts.roofline(results["roofline"]), "table": roofline_table(results["roofline"]),
            "text": "Operations and bytes are those of the textbook iteration; a kernel that keeps vectors in "
            "registers can exceed a bandwidth. Limits are measured in the same run.",
        }  # fmt: skip
    if "change_of_k" in results:
        yield {
            "name": "change_of_k", "title": "What a change of K costs", "table": None,
            "figure": charts.change_of_k(results["change_of_k"]),
            "text": "PRDP raises K again and again: where K is part of a compiled graph, each raise compiles anew.",
        }  # fmt: skip
    if "training" in results:
        yield {
            "name": "training", "title": "What the physics adds to an update", "table": None,
            "figure": charts.training(results["training"]),
            "text": "One batch of the scene: network, loss, backward and fused Adam (grey), and the share of the "
            "solves and their derivatives, at K = 1 and at the converged K.",
        }  # fmt: skip
    if "memory" in results:
        yield {
            "name": "memory", "title": "Memory of a gradient", "table": memory_table(results["memory"]),
            "figure": charts.memory(results["memory"], memory.CHARTED),
            "text": "Growth of the peak resident set by one solve with its gradients for the state and nu, batch "
            f"of {memory.BATCH}, float32, each case in a process of its own.",
        }  # fmt: skip


def memory_table(found):
    budgets = sorted({p["k"] for p in found})
    rows = [["problem", "derivative", *(f"K = {k}: MB (s)" for k in budgets)]]
    for case, mode in dict.fromkeys((p["case"], p["mode"]) for p in found):
        of = {p["k"]: p for p in found if (p["case"], p["mode"]) == (case, mode)}
        cells = (f"{of[k]['bytes'] / 1e6:.1f} ({of[k]['seconds']:.2g})" for k in budgets)
        rows.append([memory.CASES[case], mode, *cells])
    return rows


def accuracy_table(points):
    rows = [["solver", "derivative", "K", "residual", "gradient error", "solve, ms", "solve and gradient, ms"]]
    for p in points:
        rows.append([p["label"], p["mode"], "" if p["k"] is None else p["k"], f"{p['residual']:.1e}",
                     f"{p['gradient_error']:.1e}", f"{1e3 * p['forward_seconds']['min']:.4g}",
                     f"{1e3 * p['both_seconds']['min']:.4g}"])  # fmt: skip
    return rows


def large_table(points):
    rows = [["unknowns", "solver", "first solve, s", "one more, s", "iterations", "residual", "status"]]
    for p in points:
        rows.append([p["grid"], p["solver"], f"{p['seconds']:.3g}", f"{p['again']:.3g}", p["iterations"],
                     f"{p['residual']:.1e}", p["status"]])  # fmt: skip
    return rows


def roofline_table(found):
    rows = [["problem", "solver", "K", "residual", "ms", "GFLOP/s", "GB/s", "sample's vectors, KB"]]
    for p in found["points"]:
        rows.append([p["problem"], p["label"], p["k"], f"{p['residual']:.1e}", f"{1e3 * p['seconds']:.4g}",
                     f"{p['gflops']:.1f}", f"{p['gb_per_s']:.0f}", f"{p['sample_bytes'] / 1024:.0f}"])  # fmt: skip
    return rows
