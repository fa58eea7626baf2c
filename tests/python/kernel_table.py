"""Compile the kernel of each method and operator for several cards and print what each takes: `make kernels`."""

import functools
import re
import time

import test_gpu_multigrid as multigrid
import torch
from fibers import Fibers
from test_gpu_kernels import CASES, OPERATORS, right_hand_sides, solve, solver

CAPABILITIES = 80, 90, 120


def runs():
    """The label of each, its operator, and a solve in a dtype."""

    def alone(name, method, dtype):
        return OPERATORS[name](dtype), right_hand_sides(name, dtype), solver(method, max_iter=1)

    def with_cycles(name, method, dtype):
        a, b = multigrid.OPERATORS[name][0](dtype), multigrid.right_hand_sides(name, dtype)
        return a, b, multigrid.with_cycles(method, max_iter=1)

    for name, method in CASES:
        yield method.__name__, name, functools.partial(alone, name, method)
    for name, method, _ in multigrid.CASES:
        yield f"{method.__name__}, multigrid", name, functools.partial(with_cycles, name, method)


def main():
    print("| method | operator | dtype | card | seconds | registers | spilled bytes | stack |")
    print("|---|---|---|---|---|---|---|---|")
    for label, name, problem in runs():
        for dtype in (torch.float32, torch.float64):
            solve(*problem(dtype), {"threads": 1024})
            for capability in CAPABILITIES:
                begin = time.perf_counter()
                said = Fibers().resources_of_last(capability)
                seconds = time.perf_counter() - begin
                registers = re.search(r"Used (\d+) registers", said)
                if not registers:
                    raise SystemExit(f"{label} of {name} for sm_{capability}: {said}")
                spilled = sum(int(n) for n in re.findall(r"(\d+) bytes spill stores", said))
                stack = max(int(n) for n in re.findall(r"(\d+) bytes cumulative stack size", said) or [0])
                print(
                    f"| {label} | {name} | {str(dtype)[6:]} | sm_{capability} | {seconds:.1f} |"
                    f" {registers[1]} | {spilled} | {stack} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
