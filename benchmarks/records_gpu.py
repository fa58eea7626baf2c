"""`make records-gpu`: train the scenes of PARTS on a GPU, and keep what came of it in docs/results/gpu.

A call ends after ten minutes at the latest, with status 3 if there is more to do; the same command goes on from there.
`python -m benchmarks.records_gpu --list` prints the parts; NAMES choose some. Each record names commit, torch and card.
"""

import argparse
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks.records import ROOT
from prdp_torch.experiments import _C, records

RUNS = ROOT / "runs" / "records-gpu"
KEPT = "results/gpu"  # in docs
MORE_TO_DO = 3
SEEDS = 3
ROWS = ("converged", "rtol_0.1", "rtol_0.01", "rtol_0.001", "prdp", "auto")
SCENES = {  # and the solver that is the strongest where nothing is refined
    "burgers_2d": "multigrid",
    "benchmarks/scenes/burgers_2d_192.toml": "multigrid",
    "benchmarks/scenes/diffusion_inverse_256.toml": "multigrid",
    "kolmogorov": "direct",
    "kolmogorov_unet": "direct",
    "heat_3d": "direct",
    "navier_stokes": None,  # its own: no other one solves it on a GPU
}


class Part(NamedTuple):
    """A row of a scene, with all seeds."""

    scene: str
    row: str

    @property
    def name(self):
        return f"{self.record}/{self.row}"

    @property
    def record(self):
        return Path(self.scene).stem

    def command(self, folder, device):
        """Trainings that are there are kept, and the rows that are there as well."""
        summary = folder / "summary.json"
        kept = ["--keep", str(summary)] if summary.exists() else []
        what = [self.scene, "--device", device, "--rows", self.row, "--seeds", str(SEEDS), "--resume"]
        return ["-m", "benchmarks.refinement", *what, "--out", str(folder), *kept]

    def is_done(self, folder):
        path = folder / "summary.json"
        return path.exists() and self.row in [row["label"] for row in json.loads(path.read_text())["rows"]]


PARTS = [Part(scene, row) for scene, best in SCENES.items() for row in (*ROWS, *([best] if best else []))]


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.records_gpu", description=__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help="of a part, or of all parts of a scene; all by default"
    )
    parser.add_argument("--list", action="store_true", help="print the parts, and do nothing")
    parser.add_argument("--minutes", type=float, default=10.0, help="after which the call ends")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--dirty", action="store_true", help="also with changes that are not committed: records say so")
    options = parser.parse_args()
    known = [name for part in PARTS for name in (part.record, part.name)]
    if unknown := set(options.names) - set(known):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; allowed: {', '.join(dict.fromkeys(known))}")
    chosen = [part for part in PARTS if not options.names or {part.name, part.record} & set(options.names)]
    if options.list:
        for part in chosen:
            print(f"{part.name:36} python {' '.join(part.command(_shown('COMMIT', part), options.device))}")
        return
    try:
        _C.find_device(options.device)
    except ValueError as error:
        parser.exit(2, f"records-gpu: {error}\n")
    commit = records.environment()["commit"]
    if commit is None or (commit.endswith("-dirty") and not options.dirty):
        parser.error("there are changes that are not committed: commit them, or pass --dirty")
    sys.exit(make(chosen, commit, options.device, time.monotonic() + 60 * options.minutes))


def _shown(commit, part):
    return (RUNS / commit / part.record).relative_to(ROOT)


def make(parts, commit, device, end):
    """Train until `end` of the monotonic clock what is not there yet. Returns the exit status."""
    for part in parts:
        folder = RUNS / commit / part.record
        if not part.is_done(folder):
            print(part.name, flush=True)
            status = _run([sys.executable, *part.command(folder, device)], end - time.monotonic())
            if status:
                return status
    for name in dict.fromkeys(part.record for part in parts):  # only now: a changed file marks a record as dirty
        target = ROOT / "docs" / KEPT / f"{name}.json"
        target.parent.mkdir(exist_ok=True)
        shutil.copy(RUNS / commit / name / "summary.json", target)
    return 0


def _run(command, seconds):
    """The status of a command that is interrupted, as by Ctrl-C, where it takes longer: a training then leaves a
    checkpoint."""
    with subprocess.Popen(command, cwd=ROOT) as running:
        try:
            return running.wait(max(0.0, seconds))
        except subprocess.TimeoutExpired:
            running.send_signal(signal.SIGINT)
    print("records-gpu: the time is over; the same command goes on from here", file=sys.stderr)
    return MORE_TO_DO


if __name__ == "__main__":
    main()
