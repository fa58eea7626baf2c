"""Compile every kernel that methods, operators, flows and gradients ask for, for several cards, and print what each
takes: `make kernels`."""

import re
import time

import test_gpu_flow as flows
import test_gpu_multigrid as multigrid
import test_gpu_products as products
import torch
from fibers import Fibers
from test_gpu_kernels import CASES, DIVIDED, OPERATORS, noise, right_hand_sides, solve, solver

import prdp_torch as prdp

CAPABILITIES = 80, 90, 120
DEVICE = {"threads": 1024}  # the grids of the tests, of some 60 cells, take 64 of them
LONGEST = 5  # seconds that a first call may take
SIZES = {"64²": 64, "132², a team of two blocks": 132}


def kernels_of_solves(dtype):
    """With a label each."""
    for name, method in CASES:
        solve(OPERATORS[name](dtype), right_hand_sides(name, dtype), solver(method, max_iter=1), DEVICE)
        yield f"{method.__name__} of {name}", Fibers().kernels()
    for name, method, _ in multigrid.CASES:
        a, b = multigrid.OPERATORS[name][0](dtype), multigrid.right_hand_sides(name, dtype)
        solve(a, b, multigrid.with_cycles(method, max_iter=1), DEVICE)
        coarse_grids, cycles = Fibers().kernels()
        yield f"coarse grids of {name}", [coarse_grids]
        yield f"{method.__name__}, multigrid of {name}", [cycles]

    for name, method in DIVIDED:
        of = solver(method, max_iter=1, preconditioner="diagonal")
        solve(OPERATORS[name](dtype), right_hand_sides(name, dtype), of, DEVICE)
        yield f"{method.__name__}, diagonal of {name}", Fibers().kernels()


def kernels_of_sizes(dtype):
    """Of grids that fill a block, and more."""
    for label, n in SIZES.items():
        a, b = prdp.operators.Diffusion(torch.ones(1, n, n, dtype=dtype), 1.0), noise(1, 1, n, n, dtype=dtype)
        for name, of in {
            "CG": prdp.CG(1),
            "GMRES(20)": prdp.GMRES(1),
            "CG, multigrid": prdp.CG(1, preconditioner="multigrid"),
        }.items():
            solve(a, b, of, DEVICE)
            for kernel in Fibers().kernels():
                yield f"{name} of diffusion, {label}", [kernel]


def kernels_of_large_samples(dtype):
    """Those of a team of two, with the numbers of another grid and its team in place of its own."""
    for label, n, dims, large, blocks in (
        ("1024²", 132, 2, "1, 1024, 1024", 64),
        ("128³", 26, 3, "128, 128, 128", 128),
    ):
        shape = (n,) * dims
        a, b = prdp.operators.Diffusion(torch.ones(1, *shape, dtype=dtype), 1.0), noise(1, 1, *shape, dtype=dtype)
        for name, of in {"CG": prdp.CG(1), "CG, multigrid": prdp.CG(1, preconditioner="multigrid")}.items():
            solve(a, b, of, DEVICE)
            for kernel in Fibers().kernels():
                text = re.sub(r"Grid<\d+, \d+, \d+>", f"Grid<{large}>", kernel.text)
                text = re.sub(r"(>, (?:\d, )?)2, (1024|512)", rf"\g<1>{blocks}, \2", text)
                yield f"{name} of diffusion, {label}", [kernel._replace(text=text)]


def kernels_of_loops(dtype):
    """Of a step of each flow, and of the gradients of each field, forward and back."""
    for name in flows.CASES:
        with Fibers(**DEVICE):
            flows.outcome(name, dtype, steps=1)
        yield f"flow, {name}", Fibers().kernels()
    for name in products.CASES:
        products.gradients(name, dtype, **DEVICE)
        yield f"gradients, {name}", Fibers().kernels()


def print_row(label, dtype, kernel, capability):
    for _ in range(2):  # a machine may pause
        begin = time.process_time()
        said = kernel.resources(capability)
        seconds = time.process_time() - begin
        if seconds <= LONGEST:
            break
    else:
        raise SystemExit(f"{label} for sm_{capability}: {seconds:.1f} s to compile, at most {LONGEST} are allowed")
    registers = re.search(r"Used (\d+) registers", said)
    if not registers:
        raise SystemExit(f"{label} for sm_{capability}: {said}")
    spilled = sum(int(n) for n in re.findall(r"(\d+) bytes spill stores", said))
    stack = max(int(n) for n in re.findall(r"(\d+) bytes cumulative stack size", said) or [0])
    shared = max(int(n) for n in re.findall(r"(\d+) bytes smem", said) or [0])
    print(
        f"| {label} | {str(dtype)[6:]} | sm_{capability} | {seconds:.1f} | {registers[1]} | {spilled} | {stack} |"
        f" {shared} | {kernel.block_memory} |",
        flush=True,
    )


def main():
    print("| kernel | dtype | card | seconds | registers | spilled bytes | stack | shared, static | shared, launch |")
    print("|---|---|---|---|---|---|---|---|---|")
    seen = set()
    for dtype in (torch.float32, torch.float64):
        for kernels_of in (kernels_of_solves, kernels_of_sizes, kernels_of_large_samples, kernels_of_loops):
            for label, kernels in kernels_of(dtype):
                for kernel in kernels:
                    if kernel in seen:
                        continue
                    seen.add(kernel)
                    body = re.search(r"Each(?:Point|Sample)<(\w+)", kernel.text)
                    for capability in CAPABILITIES:
                        print_row(f"{label}: {body[1]}" if body else label, dtype, kernel, capability)


if __name__ == "__main__":
    main()
