"""What the first call with a new K costs, after calls with others: a graph compiled for one K is compiled again."""

import importlib
import importlib.util
import time

import torch
from torch._inductor.utils import fresh_cache

from benchmarks import ours, peers
from benchmarks.problems import PROBLEMS

STEPS = 6  # K, K + 1, …: what a controller does
LONGEST = 120.0  # seconds after which no further K is tried


@fresh_cache()  # else torch.compile finds what earlier runs of the benchmark have left
def run(report, quick=False):
    """[{problem, label, k, first_seconds, later_seconds}] of the solve with its gradient."""
    found = []
    for name in ["heat_1d"] if quick else ["heat_1d", "heat_2d", "burgers_1d", "navier_stokes"]:
        problem = PROBLEMS[name]()
        paper = next(label for label in ours.methods(problem))
        mine = [entry for entry in ours.entries(problem, ("implicit",)) if entry.label == paper]
        others = [entry for entry in peers.entries(problem) if entry.same_as is not None]
        if importlib.util.find_spec("jax"):
            others.append(importlib.import_module("benchmarks.peers.jax_loops").entry_for_any(problem))
        for entry in mine + others:
            report(f"change of K: {problem.title}, {entry.label}")
            found += first_calls(problem, entry)
    if importlib.util.find_spec("torch._dynamo"):
        torch._dynamo.reset()
    return found


def first_calls(problem, entry):
    found, began = [], time.perf_counter()
    for k in range(problem.k, problem.k + STEPS):
        _, both = entry.prepare(k)
        started = time.perf_counter()
        answer = both()
        middle = time.perf_counter()
        both()
        later = time.perf_counter() - middle
        residual, gradient_error = problem.errors(*answer)
        found.append({"problem": problem.title, "label": entry.label, "k": k, "first_seconds": middle - started,
                      "later_seconds": later, "residual": residual, "gradient_error": gradient_error})  # fmt: skip
        if time.perf_counter() - began > LONGEST:
            break
    return found
