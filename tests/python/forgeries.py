"""Forged files: changed copies of what the trainers read, with the fingerprints that belong to them.

    python tests/python/forgeries.py --count 10000 --out docs/stability/forgeries.json

Each of them must be refused in one sentence that names the file, be passed over for the checkpoint before (and the
training then ends as the one that was left alone), or be taken and lead to no error. test_forgeries.py tries a few.
"""

import argparse
import collections
import faulthandler
import json
import os
import random
import sys
import tempfile
import time
from pathlib import Path

import torch
from forged_data import Cache, CppWeights, Hdf5, Npz, Weights
from forged_trainings import CppCheckpoint, CppRecord, PythonCheckpoint, PythonRecord
from forgery import BEFORE, REFUSED, SETTINGS, TAKEN

from prdp_torch.experiments import records

# What reads the files of a kind, and its share. The trainers share their readers, and a program takes long to start.
KINDS = {
    "checkpoints, Python": (PythonCheckpoint, 0.35),
    "checkpoints, C++": (CppCheckpoint, 0.05),
    "records, Python": (PythonRecord, 0.28),
    "records, C++": (CppRecord, 0.03),
    "weights, Python": (Weights, 0.08),
    "weights, C++": (CppWeights, 0.02),
    "cached data": (Cache, 0.04),
    "data, HDF5": (Hdf5, 0.08),
    "data, .npz": (Npz, 0.07),
}


def attack(kind, count, folder, seed=0):
    """The number of each outcome, and the faults as (number, words)."""
    made, outcomes, faults = KINDS[kind][0](folder), collections.Counter(), []
    for number in range(count):
        dice = random.Random(f"{seed} {kind} {number}")
        faulthandler.dump_traceback_later(60, exit=True)  # a reader that does not come back
        try:
            outcomes[made.try_one(dice)] += 1
        except Exception as error:
            faults.append((number, f"{type(error).__name__}: {error}"))
        finally:
            faulthandler.cancel_dump_traceback_later()
    return outcomes, faults


def keep(path, row):
    """In the order of the kinds."""
    rows = json.loads(path.read_text()) if path.exists() else []
    by_kind = {old["files"]: old for old in rows} | {row["files"]: row}
    records.write(path, [by_kind[kind] for kind in KINDS if kind in by_kind])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=10_000, help="of all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--out", type=Path, help="a file for the record, in JSON; rows of other kinds in it stay")
    given = parser.parse_args()
    os.environ.update(SETTINGS)
    torch.set_num_threads(1)
    rows, environment = [], records.environment()
    environment["command"] = f"forgeries.py --count {given.count} --seed {given.seed}"
    print(f"| files | forged | {REFUSED} | {BEFORE} | {TAKEN} | faults |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for number, kind in enumerate(given.kinds):
            started, count = time.monotonic(), round(KINDS[kind][1] * given.count)
            outcomes, faults = attack(kind, count, Path(folder) / str(number), given.seed)
            row = {"files": kind, "forged": count, **{name: outcomes[name] for name in (REFUSED, BEFORE, TAKEN)}}
            print("|", " | ".join(map(str, [*row.values(), len(faults)])), "|", flush=True)
            for fault in faults[:20]:
                print("   ", *fault, file=sys.stderr)
            seconds = round(time.monotonic() - started, 1)
            rows.append({**row, "faults": len(faults), "seconds": seconds, **environment})
            if given.out:
                keep(given.out, rows[-1])
    return 1 if any(row["faults"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
