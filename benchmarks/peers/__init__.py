"""Other libraries on the same problems, each at its own best settings; those that are installed."""

import importlib
import importlib.util

MODULES = {"torch_eager": "torch", "torch_compiled": "torch", "jax_loops": "jax", "lineax_solvers": "lineax",
           "scipy_direct": "scipy"}  # fmt: skip


def entries(problem):
    for module, needs in MODULES.items():
        if importlib.util.find_spec(needs):
            yield from importlib.import_module(f"benchmarks.peers.{module}").entries(problem)
