"""This library on any device beside an eager torch loop there: `python -m benchmarks.devices --device cuda`.

The problems are those of the suites. A call is a solve of K iterations with its gradient for b, and ends when the
device has. One JSON record a line; the time is that which passes.
"""

import argparse
import json
import statistics
import time

import torch

import prdp_torch as prdp
from benchmarks import problems
from benchmarks.peers import stencils, torch_eager
from prdp_torch import operators


def on(device, problem):
    """The problem's operator on the device, and its product as a function."""
    winds = None if problem.winds is None else problem.winds.to(device)
    if problem.kappa is not None:
        a = operators.Stencil(problem.operator.tensors[0].to(device), problem_offsets(problem), "periodic")
    elif problem.name.startswith("heat"):
        a = operators.Heat(problem.shape, problem.nu, problem.dt)
    else:
        make = operators.Burgers if problem.name.startswith("burgers") else operators.NavierStokes
        a = make(winds, problem.nu, problem.dt)
    return a, stencils.make(problem, stencils.TorchBackend, lambda array: torch.from_numpy(array).to(device))


def problem_offsets(problem):
    return problems._C.diffusion_stencil(problem.kappa, problem.dt)[1]


def calls(problem, device):
    """{name: a solve with its gradient}, the solver of the suite with the K of the suite."""
    a, product = on(device, problem)
    b, g, k = problem.b.to(device), problem.g.to(device), problem.k
    solver = problem.solver(k)

    def ours(a, solver, **options):
        def call():
            leaf = b.clone().requires_grad_()
            u, _ = prdp.linear_solve(a, leaf, solver, **options)
            u.backward(g)
            return u.detach(), leaf.grad

        return call

    loops = {"jacobi": torch_eager.jacobi, "gmres": torch_eager.gmres, "cg": torch_eager.cg}
    more = (solver.restart,) if solver.method == "gmres" else ()

    def eager():
        with torch.no_grad():
            return [loops[solver.method](product, turned, v, k, *more) for turned, v in ((False, b), (True, g))]

    found = {f"{solver.method} raise": ours(a, solver), "eager torch loop": eager}
    if solver.method != "gmres":
        found[f"{solver.method} return"] = ours(a, solver, on_failure="return")
    if solver.method == "cg":
        function = operators.Function(product.apply, symmetric=True)
        found["cg on Function, raise"] = ours(function, solver)
        found["cg on Function, return"] = ours(function, solver, on_failure="return")
        found["cg, multigrid"] = ours(a, prdp.CG(5, rtol=0.0, preconditioner="multigrid"))
        found["multigrid"] = ours(a, prdp.Multigrid(5, rtol=0.0))
    return found


def seconds(call, device, rounds):
    """The median of a call, and of the time after which it had queued all its work."""
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    call()
    readings = []
    for _ in range(rounds):
        wait()
        started = time.perf_counter()
        call()
        queued = time.perf_counter() - started
        wait()
        readings.append((time.perf_counter() - started, queued))
    whole, queued = zip(*readings, strict=True)
    return {"seconds": statistics.median(whole), "queued": statistics.median(queued)}


def suite(quick):
    if quick:
        return [problems.heat((7, 7), 5, batch=2), problems.burgers((9,), 2, batch=2),
                problems.diffusion((8, 8), 5, batch=2)]  # fmt: skip
    some = [problems.PROBLEMS[name]() for name in ("heat_1d", "heat_2d", "heat_3d", "burgers_1d", "navier_stokes")]
    return [*some, problems.DIFFUSION["diffusion_64"](), problems.DIFFUSION["diffusion_256"]()]


def run(device, quick=False):
    """Yields a record for each problem and way."""
    for problem in suite(quick):
        for way, call in calls(problem, device).items():
            residual, _ = problem.errors(call()[0].cpu())
            yield {
                "problem": problem.title, "k": problem.k, "way": way, "residual": residual,
                **seconds(call, device, rounds=1 if quick else 9),
            }  # fmt: skip


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.devices")
    parser.add_argument("--device", type=torch.device, default=torch.device("cuda"))
    parser.add_argument("--quick", action="store_true", help="small problems, to see that all of it runs")
    options = parser.parse_args()
    of = torch.cuda.get_device_name(options.device) if options.device.type == "cuda" else "the CPU's plain loops"
    print(json.dumps({"device": str(options.device), "name": of, "torch": torch.__version__}), flush=True)
    for record in run(options.device, options.quick):
        print(json.dumps(record), flush=True)


if __name__ == "__main__":
    main()
