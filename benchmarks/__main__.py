"""The suites, on one thread: `python -m benchmarks accuracy`."""

import argparse
import importlib
import importlib.metadata
import os
import sys
from pathlib import Path

SUITES = ("accuracy", "diffusion", "size", "large", "roofline", "change_of_k", "training", "memory")
PEERS = ("torch", "jax", "lineax", "scipy", "pyamg", "phiflow", "jax-cfd", "exponax", "torch-fem")


def use_one_thread():
    """Before any library starts its pool."""
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"


def peer_versions():
    found = {}
    for name in PEERS:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("suites", nargs="*", metavar="SUITE", help=f"{', '.join(SUITES)}; all.")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"), help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="few budgets and rounds, to see that all of it runs")
    options = parser.parse_args()
    for suite in options.suites:
        if suite not in SUITES:
            parser.error(f"unknown suite '{suite}'; allowed: {', '.join(SUITES)}")
    use_one_thread()
    import torch  # only now: it reads the environment, and counts the cores for its pool

    from benchmarks import measure, page
    from prdp_torch.experiments import records

    torch.set_num_threads(1)
    measure.keep_to_one_core()
    folder = records.prepare_folder(options.out)
    environment = records.environment() | {"peers": peer_versions()}
    results = {}
    for suite in options.suites or SUITES:
        module = importlib.import_module(f"benchmarks.{suite}")
        results[suite] = module.run(lambda text: print(text, file=sys.stderr, flush=True), options.quick)
        records.write(folder / f"{suite}.json", {**environment, "quick": options.quick, suite: results[suite]})
    page.write(results, environment, folder)
    print(f"page: {folder / 'page.html'}")


if __name__ == "__main__":
    main()
