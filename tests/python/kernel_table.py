"""Compile the kernel of each method and operator for several cards and print what each takes: `make kernels`."""

import re
import time

import torch
from fibers import Fibers
from test_gpu_kernels import CASES, OPERATORS, right_hand_sides, solve, solver

CAPABILITIES = 80, 90, 120


def main():
    print("| method | operator | dtype | card | seconds | registers | spilled bytes | stack |")
    print("|---|---|---|---|---|---|---|---|")
    for name, method in CASES:
        for dtype in (torch.float32, torch.float64):
            solve(OPERATORS[name](dtype), right_hand_sides(name, dtype), solver(method, max_iter=1), {"threads": 1024})
            for capability in CAPABILITIES:
                begin = time.perf_counter()
                said = Fibers().resources_of_last(capability)
                seconds = time.perf_counter() - begin
                registers = re.search(r"Used (\d+) registers", said)
                if not registers:
                    raise SystemExit(f"{method.__name__} of {name} for sm_{capability}: {said}")
                spilled = sum(int(n) for n in re.findall(r"(\d+) bytes spill stores", said))
                stack = max(int(n) for n in re.findall(r"(\d+) bytes cumulative stack size", said) or [0])
                print(
                    f"| {method.__name__} | {name} | {str(dtype)[6:]} | sm_{capability} | {seconds:.1f} |"
                    f" {registers[1]} | {spilled} | {stack} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
