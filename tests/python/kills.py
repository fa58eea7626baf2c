"""Trainings that are killed, and must end as those that were left alone, bit for bit.

    python tests/python/kills.py --kills 100 --out docs/stability/kills.json

kills each trainer so many times in each task at random moments, and so many times between the renames that put files
in their places (kills_at_renames.py). It prints a table and keeps its rows, each in the place of an older one of the
same trainer and task. test_kills.py does so a few times.
"""

import argparse
import itertools
import json
import multiprocessing
import os
import random
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from helpers import small_field, tiny, written

from prdp_torch.experiments import _C, cli, records

ROOT = Path(__file__).parents[2]
# Python's trainer is forked from a process that has imported torch, so that kills hit the training.
FORK = multiprocessing.get_context("forkserver")
FORK.set_forkserver_preload(["helpers", "prdp_torch.experiments.cli"])
TASKS = {
    "emulator": (lambda folder: written(folder), 40),
    "parameters": (lambda folder: written(folder, scene="poisson_1p"), 200),
    "corrector": (tiny, 12),
    "field": (small_field, 40),
}
TRAINERS = ("python", "cpp")
AT_RENAMES = "emulator, at renames"


@dataclass
class Count:
    """What came of the kills."""

    kills: int = 0
    in_training: int = 0  # of them, those that a checkpoint or a record was there to survive
    runs: int = 0  # trainings that were killed at least once and then finished
    lost: int = 0  # of them, those that differ from the one left alone
    damaged: int = 0  # files that could not be read after a kill


def _prdp(arguments, environment):
    os.environ.update(environment)
    torch.set_num_threads(1)
    with open(os.devnull, "w") as nowhere:
        sys.stdout = sys.stderr = nowhere
        sys.argv = ["prdp", *arguments]
        cli.main()


class Attempt:
    """A trainer at work."""

    def __init__(self, trainer, arguments, cache):
        environment = {"PRDP_CACHE": str(cache), "OMP_NUM_THREADS": "1", "PRDP_CHECKPOINT_SECONDS": "0"}
        if trainer == "cpp":
            command = [ROOT / "build" / "prdp_train", "--prdp", *arguments]
            nowhere = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            self.process = subprocess.Popen(command, env={**os.environ, **environment}, **nowhere)
            self.wait = self.process.wait
        else:
            self.process = FORK.Process(target=_prdp, args=(["train", "--prdp", *arguments], environment))
            self.process.start()
            self.wait = self.process.join

    def killed_after(self, seconds):
        """Whether it was still at work then, and is now killed."""
        end = time.monotonic() + seconds
        while self._works() and time.monotonic() < end:
            time.sleep(max(0.0, min(0.002, end - time.monotonic())))
        if not self._works():
            return False
        self.process.kill()
        self.wait()
        return True

    def _works(self):
        return self.process.is_alive() if hasattr(self.process, "is_alive") else self.process.poll() is None

    def status(self):
        """Of one that is left alone."""
        self.wait()
        return self.process.exitcode if hasattr(self.process, "exitcode") else self.process.returncode


def result(folder):
    """All that must be the same: the curves but the seconds, and the weights."""
    record = records.read(folder / "prdp/seed_0.json")
    weights = folder / "prdp/seed_0.pt"
    kept = torch.load(weights, weights_only=True) if weights.exists() else {}
    curves = {name: values for name, values in record["curves"].items() if name != "seconds"}
    return json.dumps(curves), {name: w.flatten().tolist() for name, w in kept.items()}


def kill(trainer, task, kills, folder, dice):
    """Kill the trainer so many times, at moments that the dice choose. Returns a `Count`."""
    make, intervals = TASKS[task]
    folder.mkdir()
    scene = make(folder)
    cache = folder / "cache"

    def attempt(out, *more):
        return Attempt(trainer, [str(scene), "--out", str(out), "--intervals", str(intervals), *more], cache)

    for _ in range(2):  # the second time, data are there
        started = time.monotonic()
        assert attempt(folder / "alone").status() == 0
        whole = time.monotonic() - started
    alone, count = result(folder / "alone"), Count()
    for number in itertools.count():
        if count.kills == kills:
            return count
        out, killed = folder / f"killed_{number}", 0
        while count.kills < kills and attempt(out, "--resume").killed_after(dice.uniform(0, whole)):
            killed += 1
            count.kills += 1
            left = [path for path in (out / "prdp").glob("seed_0.*") if path.suffix in (".json", ".checkpoint")]
            count.in_training += bool(left)
            count.damaged += sum(not _is_whole(path) for path in left)
        finished = attempt(out, "--resume").status() == 0
        if not killed:
            continue
        count.runs += 1
        if not finished:
            count.lost += 1
            continue
        left = sorted(path.name for path in (out / "prdp").iterdir())
        count.lost += result(out) != alone or left != sorted({"seed_0.json", *(["seed_0.pt"] if alone[1] else [])})


def _is_whole(path):
    """Whether a record or a checkpoint has the fingerprint that it says."""
    if path.suffix == ".json":
        try:
            return records.read(path) is not None
        except ValueError:
            return False
    mark, rest = path.read_bytes().split(b"\n", 1)
    return mark.endswith(_C.fingerprint(rest).encode())


def counted(trainer, task, kills, folder, dice):
    """The `Count` of one row."""
    if task != AT_RENAMES:
        return kill(trainer, task, kills, folder, dice)
    import kills_at_renames  # which needs this module

    return kills_at_renames.kill(trainer, kills, folder, dice)


def keep(path, row):
    rows = json.loads(path.read_text()) if path.exists() else []
    others = [old for old in rows if (old["trainer"], old["task"]) != (row["trainer"], row["task"])]
    records.write(path, [*others, row])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=100, help="of each trainer in each task")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--trainers", nargs="+", choices=TRAINERS, default=TRAINERS)
    parser.add_argument("--tasks", nargs="+", choices=[*TASKS, AT_RENAMES], default=[*TASKS, AT_RENAMES])
    parser.add_argument("--out", type=Path, help="a file for the record, in JSON; rows of other kills in it stay")
    given = parser.parse_args()
    rows, environment = [], records.environment()
    environment["command"] = f"kills.py --kills {given.kills} --seed {given.seed}"
    print("| trainer | task | kills | with files | trainings | lost | damaged files |\n|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for trainer in given.trainers:
            for number, task in enumerate(given.tasks):
                dice = random.Random(f"{given.seed} {trainer} {task}")
                started = time.monotonic()
                count = asdict(counted(trainer, task, given.kills, Path(folder) / f"{trainer}_{number}", dice))
                print("|", " | ".join(map(str, (trainer, task, *count.values()))), "|", flush=True)
                seconds = round(time.monotonic() - started, 1)
                rows.append({"trainer": trainer, "task": task, **count, "seconds": seconds, **environment})
                if given.out:
                    keep(given.out, rows[-1])
    return 1 if any(row["lost"] or row["damaged"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
