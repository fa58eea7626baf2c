"""What a second thread saves of a solve with its gradient, and a rollout of as many single steps:
`python -m benchmarks.calls`. It takes the time that passes, so it needs two free cores."""

import argparse
import time
from pathlib import Path

import torch

import prdp_torch as prdp
from benchmarks import measure, ours, problems
from prdp_torch.experiments import records

BATCHES = (25, 200)
STEPS = 50


def with_two_threads(name, batch):
    problem = problems.PROBLEMS[name](batch=batch)
    _, both = ours.calls(problem, problem.solver(problem.k), "implicit")

    def call(threads):
        torch.set_num_threads(threads)
        return both()

    residual, gradient_error = problem.errors(*call(1))
    seconds = _seconds({"one": lambda: call(1), "two": lambda: call(2)})
    return {"problem": name, "batch": batch, "residual": residual, "gradient_error": gradient_error, **seconds}


def in_a_rollout():
    """Seconds of a step of heat_1d and its gradient, in one operation and in single calls."""
    torch.set_num_threads(1)
    problem = problems.PROBLEMS["heat_1d"]()
    step = prdp.Heat(problem.shape, problem.nu, problem.dt, solver=problem.solver(problem.k))

    def single(u):
        for _ in range(STEPS):
            u = step(u)
        return u

    def gradient(advance):
        u = problem.b.clone().requires_grad_()
        advance(u).backward(problem.g)
        return u.grad

    ways = {"rollout": lambda u: step.rollout(u, STEPS)[:, -1], "single": single}
    first, second = (gradient(way) for way in ways.values())
    difference = float((first - second).norm() / second.norm())
    seconds = _seconds({name: lambda way=way: gradient(way) for name, way in ways.items()})
    return {
        "problem": problem.name, "steps": STEPS, "k": problem.k, "difference": difference,
        **{way: passed / STEPS for way, passed in seconds.items()},
    }  # fmt: skip


def _seconds(calls):
    found = measure.interleaved(calls, rounds=15, clock=time.perf_counter)
    return {name: reading["min"] for name, reading in found.items()}


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calls")
    parser.add_argument("--out", type=Path, default=Path("runs/calls.json"))
    options = parser.parse_args()
    records.prepare_folder(options.out.parent)
    environment = records.environment()  # before the number of threads changes
    threads = []
    for batch in BATCHES:
        for name in problems.PROBLEMS:
            row = with_two_threads(name, batch)
            threads.append(row)
            print(f"{name}, batch {batch}: two threads {row['one'] / row['two']:.2f} times as fast", flush=True)
    row = in_a_rollout()
    print(f"a step: {1e6 * row['rollout']:.0f} µs in a rollout, {1e6 * row['single']:.0f} µs in single calls")
    records.write(options.out, {**environment, "calls": {"threads": threads, "rollout": row}})


if __name__ == "__main__":
    main()
