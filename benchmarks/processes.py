"""Two processes against two threads and against one: `python -m benchmarks.processes`.

Trains the same scene with the same batches in each of the three ways, several times in turn, and keeps the shortest
time of each beside the metric that it has reached. It needs two free cores.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from prdp_torch.experiments import records

SCENES = {"heat_1d": 20, "heat_2d": 6, "navier_stokes": 1}  # with the intervals to train for
WAYS = ((1, 1), (1, 2), (2, 1))  # processes, threads of each


def train(scene, intervals, processes, threads, out):
    """Train in processes of their own. Returns (seconds of the intervals, final metric)."""
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    command = [*(launcher if processes > 1 else []), "-m", "prdp_torch", "train", scene, "--prdp"]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    subprocess.run(
        [sys.executable, *command, "--intervals", str(intervals), "--out", str(out)],
        env=environment, stdout=subprocess.DEVNULL, check=True,
    )  # fmt: skip
    curves = records.read(next(Path(out).glob("*/seed_0.json")))["curves"]
    return sum(curves["seconds"]), curves["metric"][-1]


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.processes")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--intervals", type=int, help="in place of those chosen for each scene")
    parser.add_argument("--out", type=Path, default=Path("runs/processes.json"))
    options = parser.parse_args()
    records.prepare_folder(options.out.parent)
    record = {**records.environment(), "rounds": options.rounds, "rows": []}
    print("| scene | intervals | processes | threads | seconds | metric |\n|---|---|---|---|---|---|")
    for scene in options.scenes:
        intervals = options.intervals or SCENES[scene]
        found = {way: [] for way in WAYS}
        for _ in range(options.rounds):
            for way in WAYS:
                with tempfile.TemporaryDirectory() as folder:
                    found[way].append(train(scene, intervals, *way, folder))
        for (processes, threads), runs in found.items():
            seconds, metric = min(runs)
            row = {"scene": scene, "intervals": intervals, "processes": processes, "threads": threads,
                   "seconds": seconds, "metric": metric}  # fmt: skip
            record["rows"].append(row)
            print(f"| {scene} | {intervals} | {processes} | {threads} | {seconds:.2f} | {metric:.6e} |", flush=True)
        records.write(options.out, record)


if __name__ == "__main__":
    main()
