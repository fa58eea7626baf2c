"""The size of the network: heat_1d with widths that span an order of magnitude of parameters (paper, appendix)."""

import numpy as np
from matplotlib.ticker import NullLocator

from benchmarks.studies.evaluation import spread
from benchmarks.studies.trainings import saved
from prdp_torch.experiments.charts import make_figure

WIDTHS = (16, 24, 32, 48, 64, 96, 128)
UNKNOWNS, VALID = 30, 100
WAYS = ("converged", "prdp", "auto")


def run(study, seeds, quick):
    for width in WIDTHS[:1] if quick else WIDTHS:
        for how in WAYS:
            for seed in range(seeds):
                study.train("heat_1d", how, seed, {"data.valid": VALID, "network.hidden": [width] * 3})


def parameters(width):
    """Weights and biases of a perceptron with three hidden layers."""
    return 2 * UNKNOWNS * width + 2 * width**2 + 3 * width + UNKNOWNS


def _of(rows, width, how):
    return [r for r in rows if r["changes"]["network.hidden"][0] == width and r["how"] == how]


def _widths(rows):
    return sorted({r["changes"]["network.hidden"][0] for r in rows})


def exponent(rows, how):
    """p of error ∝ parameters^p, by least squares of the logarithms."""
    n = np.log([parameters(r["changes"]["network.hidden"][0]) for r in rows if r["how"] == how])
    error = np.log([r["error"] for r in rows if r["how"] == how])
    return np.polyfit(n, error, 1)[0] if len(set(n)) > 1 else float("nan")


def table(rows):
    lines = ["| width | parameters | converged | PRDP | iterations saved | auto | products saved by auto |"]
    lines.append("|---|---|---|---|---|---|---|")
    for width in _widths(rows):
        converged, prdp, auto = (_of(rows, width, how) for how in WAYS)
        lines.append(
            f"| {width} | {parameters(width):,} | {_errors(converged)} | {_errors(prdp)} "
            f"| {saved(prdp, converged, 'iterations')} | {_errors(auto)} | {saved(auto, converged, 'products')} |"
        )
    powers = ", ".join(f"{how} {exponent(rows, how):.2f}" for how in WAYS)
    return "\n".join([*lines, "", f"error ∝ parameters^p with p: {powers}"])


def _errors(rows):
    return spread([r["error"] for r in rows])


def chart(rows):
    figure, (left, right) = make_figure(panels=2)
    widths = _widths(rows)
    n = [parameters(width) for width in widths]
    for how, colour in zip(WAYS, ("#222222", "#d62728", "#1f77b4"), strict=True):
        errors = [[r["error"] for r in _of(rows, width, how)] for width in widths]
        products = [np.mean([r["products"] for r in _of(rows, width, how)]) for width in widths]
        middle, spread = [np.mean(e) for e in errors], [np.std(e) for e in errors]
        left.errorbar(n, middle, spread, color=colour, marker="o", capsize=3, label=how)
        right.plot(n, products, color=colour, marker="o", label=how)
    left.set(xscale="log", yscale="log", xlabel="parameters", ylabel="validation error on 100 samples")
    right.set(xscale="log", xlabel="parameters", ylabel="products with A", ylim=(0, None))
    for axes in (left, right):
        axes.grid(alpha=0.3, lw=0.4)
        axes.set_xticks(n, [f"{x:,}" for x in n], rotation=45)
        axes.xaxis.set_minor_locator(NullLocator())
    right.legend(frameon=False)
    return figure
