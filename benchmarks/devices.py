"""This library on any device, beside eager torch loops and, where it is installed, JAX on the same device:
`python -m benchmarks.devices --device cuda`.

The problems are those of the suites, larger grids, and flows. A call is a solve of K iterations, or a rollout, with its
gradient, and ends when the device has. It prints a JSON record a line, the time that passes and the errors, and writes
them and their chart to a folder.
"""

import argparse
import importlib.util
import json
import os
import statistics
import time
from pathlib import Path

import torch

import prdp_torch as prdp
from benchmarks import charts, problems
from benchmarks.peers import stencils, torch_eager
from prdp_torch import operators
from prdp_torch.experiments import _C
from prdp_torch.experiments import records as files
from prdp_torch.experiments.charts import write_png

CURVES = " raise", "eager torch loop", "JAX jit"  # the ways that are timed for several K
LARGEST_FACTORED = 100_000  # unknowns of a sample, up to which the gradient is compared with that of a direct solve


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


def calls(problem, device, k):
    """{name: a solve with its gradient}, the solver of the suite with K = k."""
    a, product = on(device, problem)
    b, g = problem.b.to(device), problem.g.to(device)
    solver = problem.solver(k)

    def ours(a, solver, **options):
        def call():
            leaf = b.clone().requires_grad_()
            u, _ = prdp.linear_solve(a, leaf, solver, **options)
            u.backward(g)
            return u.detach(), leaf.grad

        return call

    more = (k, solver.restart) if solver.method == "gmres" else (k,)

    def eager():
        loop = getattr(torch_eager, solver.method)
        with torch.no_grad():
            return [loop(product, turned, v, *more) for turned, v in ((False, b), (True, g))]

    found = {f"{solver.method} raise": ours(a, solver), "eager torch loop": eager}
    found["one iteration"] = ours(a, problem.solver(1), on_failure="return")
    if with_jax(device):
        found["JAX jit"] = of_jax(problem, solver.method, *more)
    if solver.method != "gmres":
        found[f"{solver.method} return"] = ours(a, solver, on_failure="return")
    if solver.method == "cg":
        function = operators.Function(product.apply, symmetric=True)
        found["cg on Function, raise"] = ours(function, solver)
        found["cg on Function, return"] = ours(function, solver, on_failure="return")
        found["cg, multigrid"] = ours(a, prdp.CG(5, rtol=0.0, preconditioner="multigrid"))
        found["multigrid"] = ours(a, prdp.Multigrid(5, rtol=0.0))
    return found


def with_jax(device):
    """Whether there is a JAX that computes where the device is."""
    if not importlib.util.find_spec("jax"):
        return False
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # it would take most of the memory
    import jax

    return jax.default_backend() == {"cuda": "gpu"}.get(device.type, device.type)


def of_jax(problem, method, *more):
    import jax
    import jax.numpy as jnp

    from benchmarks.peers import jax_loops

    stencil = stencils.make(problem, jax_loops.Backend, jnp.asarray)
    b, g = (jnp.asarray(v.numpy()) for v in (problem.b, problem.g))
    _, both = jax_loops.compiled(stencil, getattr(jax_loops, method), *more)
    return lambda: jax.block_until_ready(both(b, g))


def errors(problem, u, gradient):
    """The residual of u and, where a direct solve can tell it, the error of the gradient for b: the batch's largest."""
    residual, _ = problem.errors(u)
    if problem.unknowns > LARGEST_FACTORED:
        return {"residual": residual}
    exact = problem.exact[1] if problem.kappa is None else problem.exact[1][0]
    return {"residual": residual, "gradient_error": problems.largest(problems.as_double(gradient) - exact, exact)}


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
    large = problems.diffusion((1024, 1024), 100, batch=4)
    return [*some, problems.DIFFUSION["diffusion_64"](), problems.DIFFUSION["diffusion_256"](), large]


def other_budgets(k, quick):
    return (2 * k,) if quick else sorted({max(1, k // 4), max(1, k // 2), 2 * k} - {k})


def flows(quick):
    """Rollouts of a `Flow` with their gradient: shape, batch, steps."""
    return [((8, 8), 2, 2)] if quick else [((64, 64), 16, 20), ((256, 256), 1, 10)]


def flow_calls(shape, batch, steps, device):
    """({name: a rollout with its gradient for the first state}, the projection in float64 on the CPU, and what the same
    call gives there by a direct solve)."""
    nu, dt = 1e-3, 1e-3

    def flow_of(solver):
        return prdp.Flow(shape, nu=nu, dt=dt, diffusion="explicit", solver=solver)

    exact = flow_of(prdp.Direct())
    noise = torch.randn(2, batch, 2, *shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    start, target = (exact.project(0.1 * v) for v in noise)

    def ours(flow, start, target):
        def call():
            leaf = start.clone().requires_grad_()
            end = flow.rollout(leaf, steps)[:, -1]
            end.backward(end.detach() - target)
            return end.detach(), leaf.grad

        return call

    pair = [v.float().to(device) for v in (start, target)]
    solvers = {"Direct": prdp.Direct(), "CG, multigrid": prdp.CG(100, rtol=1e-5, preconditioner="multigrid")}
    found = {name: ours(flow_of(solver), *pair) for name, solver in solvers.items()}
    if with_jax(device):
        from benchmarks.peers import jax_flow

        found["JAX jit, FFT"] = jax_flow.with_gradient(*(v.float().numpy() for v in (start, target)), steps, nu, dt)
    return found, exact.project, ours(exact, start, target)()


def run(device, quick=False):
    """Yields a record for each problem and way."""
    rounds = 1 if quick else 9
    for problem in suite(quick):
        for k in (problem.k, *other_budgets(problem.k, quick)):
            for way, call in calls(problem, device, k).items():
                if k != problem.k and not way.endswith(CURVES):
                    continue
                shown = {"problem": problem.title, "k": 1 if way == "one iteration" else k, "way": way}
                yield {**shown, **errors(problem, *call()), **seconds(call, device, rounds)}
    for shape, batch, steps in flows(quick):
        ways, project, exact = flow_calls(shape, batch, steps, device)
        for way, call in ways.items():
            u, gradient = map(problems.as_double, call())
            found = {"error": problems.largest(u - exact[0], exact[0])}
            # Of changes without divergence: for others the forms of the convective term are other functions.
            truth = project(exact[1])
            found["gradient_error"] = problems.largest(project(gradient) - truth, truth)
            shown = {"problem": f"Flow, {shape[0]} × {shape[1]} × {batch}, {steps} steps", "way": way}
            yield {**shown, **found, **seconds(call, device, rounds)}


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.devices")
    parser.add_argument("--device", default="cuda", help="cpu, cuda or cuda:N")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"), help="folder for devices.json and devices.png")
    parser.add_argument("--quick", action="store_true", help="small problems, to see that all of it runs")
    options = parser.parse_args()
    try:
        device = _C.find_device(options.device)
    except ValueError as error:
        parser.error(str(error))
    folder = files.prepare_folder(options.out)
    environment = files.environment(device) | {"quick": options.quick}
    print(json.dumps(environment["machine"] | environment["versions"]), flush=True)
    found = []
    for record in run(device, options.quick):
        print(json.dumps(record), flush=True)
        found.append(record)
    files.write(folder / "devices.json", {**environment, "devices": found})
    curves = [r for r in found if r["way"].endswith(CURVES) and "k" in r]
    write_png(charts.devices(curves), folder / "devices.png", dpi=110)


if __name__ == "__main__":
    main()
