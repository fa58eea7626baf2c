"""Memory of a gradient: what a solve and its derivative add to the process at their peak, against K."""

import json
import subprocess
import sys
from pathlib import Path

BUDGETS = [8, 16, 32, 64, 128]
MODES = {
    "implicit": {"backward": "implicit"},
    "unrolled": {"backward": "unrolled"},
    "unrolled, checkpoint_every='sqrt'": {"backward": "unrolled", "checkpoint_every": "sqrt"},
    "unrolled, recorded by autograd": {"backward": "unrolled"},  # create_graph=True: all iterates of all samples
}
CASES = {
    "heat_3d": "heat 3D 20³, Jacobi",
    "heat_3d_chebyshev": "heat 3D 20³, Chebyshev",  # replayed in plain tensors, all samples at once
    "navier_stokes": "Navier–Stokes 48², GMRES(8)",
}
CHARTED = {name: title for name, title in CASES.items() if name != "navier_stokes"}  # which is the allocator's noise
BATCH = 8


def run(report, quick=False):
    """[{case, mode, k, bytes, seconds}]: the growth of the peak resident set in a process of its own, and
    the time of one solve with its gradients for the state and nu."""
    found = []
    for case in CASES:
        for mode in MODES:
            report(f"memory: {CASES[case]}, {mode}")
            for k in BUDGETS[: 1 if quick else None]:
                found.append({"case": case, "mode": mode, "k": k, **in_a_process(case, mode, k)})
    return found


def in_a_process(case, mode, k):
    command = [sys.executable, "-m", "benchmarks.memory", case, mode, str(k)]
    done = subprocess.run(command, cwd=Path(__file__).parent.parent, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"memory: {case}, {mode}, K = {k} failed:\n{done.stderr}")
    return json.loads(done.stdout)


def measure_here(case, mode, k):
    import time

    import torch

    import prdp_torch as prdp

    torch.set_num_threads(1)

    def gradients(k):
        options = {"on_failure": "return", **MODES[mode]}
        nu = torch.tensor(1e-3 if case.startswith("heat") else 1e-4, requires_grad=True)
        if case.startswith("heat"):
            u = torch.randn(BATCH, 1, 20, 20, 20)
            solver = prdp.Chebyshev if case.endswith("chebyshev") else prdp.Jacobi
            step = prdp.Heat((20, 20, 20), nu, 1.0, solver=solver(k, rtol=0.0), **options)
        else:
            u = prdp.fields.project(torch.randn(BATCH, 3, 48, 48))
            solver = prdp.GMRES(k, restart=8, rtol=0.0)
            step = prdp.NavierStokes((48, 48), nu, 0.1, solver=solver, **options)
        u.requires_grad_()
        torch.autograd.grad(step(u).sum(), (u, nu), create_graph=mode.endswith("autograd"))

    torch.manual_seed(0)
    gradients(1)  # workspaces and lazy initialisation
    Path("/proc/self/clear_refs").write_text("5")  # the peak from here on
    before, started = resident("VmRSS"), time.perf_counter()
    gradients(k)
    seconds = time.perf_counter() - started
    return {"bytes": max(0, resident("VmHWM") - before), "seconds": seconds}


def resident(key):
    """Bytes that Linux says this process has, or has had at most, in memory."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])


if __name__ == "__main__":
    print(json.dumps(measure_here(sys.argv[1], sys.argv[2], int(sys.argv[3]))))
