"""Trainings that are killed right after a file got its name, and before the next one did. See kills.py."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import kills
from helpers import written

from prdp_torch.experiments import _C, records

SOURCE = Path(__file__).with_name("kill_at_rename.cpp")
# Python's trainer is forked from a process that has imported torch with the library in place.
FORKS = """
import json, os, sys
import torch
from prdp_torch.experiments import cli

for line in sys.stdin:
    arguments, environment = json.loads(line)
    child = os.fork()
    if child == 0:
        os.environ.update(environment)
        sys.stdout = sys.stderr = open(os.devnull, "w")
        sys.argv = ["prdp", "train", "--prdp", *arguments]
        torch.set_num_threads(1)
        try:
            cli.main()
        except SystemExit as end:
            os._exit(end.code or 0)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
INTERVALS = 12
# Endings of the names, and how often they are given away in a training.
PLACES = {
    ".checkpoint": INTERVALS - 1,
    ".checkpoint.before": INTERVALS - 2,
    ".pt.before": 1,
    ".pt": 1,
    ".json": 1,
}


class Runner:
    """Runs a trainer with the library loaded; returns its exit status."""

    def __init__(self, trainer, library):
        self.environment = {"OMP_NUM_THREADS": "1", "PRDP_CHECKPOINT_SECONDS": "0", "LD_PRELOAD": str(library)}
        self.forks = None
        if trainer == "python":
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            environment = {**os.environ, **self.environment}
            self.forks = subprocess.Popen([sys.executable, "-c", FORKS], env=environment, **pipes)

    def __call__(self, arguments, **changes):
        arguments, environment = list(map(str, arguments)), {**self.environment, **changes}
        if self.forks is None:
            command = [kills.ROOT / "build" / "prdp_train", "--prdp", *arguments]
            done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, timeout=300)
            return done.returncode
        print(json.dumps([arguments, environment]), file=self.forks.stdin, flush=True)
        return int(self.forks.stdout.readline())

    def close(self):
        if self.forks is not None:
            self.forks.communicate()


def kill(trainer, count, folder, dice):
    """Kill the trainer so many times, each time as it trains again into the folder of a shorter training. Returns a
    `kills.Count`."""
    folder.mkdir()
    library = folder / "kill_at_rename.so"
    subprocess.run(["c++", "-std=c++20", "-shared", "-fPIC", "-o", library, SOURCE, "-ldl"], check=True)
    scene, runner = written(folder), Runner(trainer, library)

    def run(out, intervals, *more, **changes):
        return runner([scene, "--out", out, "--intervals", intervals, *more], **changes)

    assert run(folder / "before", 2) == 0 and run(folder / "alone", INTERVALS) == 0
    alone, old = kills.result(folder / "alone"), records.read_training(folder / "before/prdp/seed_0.json")
    found = kills.Count()
    for number in range(count):
        place = list(PLACES)[number % len(PLACES)]
        out = folder / f"killed_{number}"
        shutil.copytree(folder / "before", out)
        time = dice.randint(1, PLACES[place])
        assert run(out, INTERVALS, PRDP_KILL_AFTER=f"seed_0{place}:{time}") == -9
        found.kills += 1
        found.in_training += 1
        found.damaged += not _belong_together(out / "prdp/seed_0.json", old)
        # Before the third is in its place, there may be one alone.
        states = 1 if place == ".checkpoint" and time < 3 else 2
        found.damaged += _states(out / "prdp/seed_0.checkpoint") != states
        found.runs += 1
        left = ["seed_0.json", "seed_0.pt"]
        finished = run(out, INTERVALS, "--resume") == 0
        names = sorted(path.name for path in (out / "prdp").iterdir())
        found.lost += not finished or kills.result(out) != alone or names != left
        shutil.rmtree(out)
    runner.close()
    return found


def _belong_together(record, old):
    """Whether a record is there with the weights that are its own: the old one's, or those of the training that the
    kill came to."""
    try:
        now = records.read_training(record)
        return (now == old or now["settings"]["intervals"] == INTERVALS) and _C.read_weights(record, now["weights"])
    except ValueError:
        return False


def _states(checkpoint):
    """How many different states are kept, each whole."""
    contents = [path.read_bytes() for path in (checkpoint, Path(f"{checkpoint}.before")) if path.exists()]
    assert all(kills._is_whole(path) for path in checkpoint.parent.glob("*.checkpoint*") if path.suffix != ".part")
    return len(set(contents))
