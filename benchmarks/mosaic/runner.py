"""Runs cases one after the other and keeps what they find; a case that is in the record is not run again."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

from benchmarks.mosaic import solvers
from prdp_torch.experiments import records

ROOT = Path(__file__).parents[2]
SEED = 0  # of all random fields and directions, unless a case names another


def family(task):
    module = importlib.import_module(f"benchmarks.mosaic.tasks.{task}")
    return module, solvers.FLOWS if module.FAMILY == "flow" else solvers.CONDUCTION


class Record:
    """The cases of one task, as a small JSON file."""

    def __init__(self, path, environment, quick):
        self.path = path
        self.rows = json.loads(path.read_text())["rows"] if path.exists() else []
        self.head = {**environment, "seed": SEED, "quick": quick}

    def has(self, solver, case):
        """Whether it need not run: something was found, or the solver cannot. What was not installed may be by now."""
        return any((row["solver"], row["case"]) == (solver, case) and "unavailable" not in row for row in self.rows)

    def add(self, solver, case, found):
        self.rows = [row for row in self.rows if (row["solver"], row["case"]) != (solver, case)]
        self.rows.append({"solver": solver, "case": case, "commit": self.head["commit"], **_short(found)})
        records.write(self.path, {**self.head, "rows": self.rows})


def _short(value):
    """Numbers to six digits, so that records stay small."""
    if isinstance(value, dict):
        return {key: _short(of_key) for key, of_key in value.items()}
    if isinstance(value, list):
        return [_short(entry) for entry in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def run(task, names, folder, environment, quick, again, limit, report):
    """Run the cases of a task on the solvers `names` (all if None). Returns its rows."""
    module, known = family(task)
    record = Record(folder / f"{task}.json", environment, quick)
    for case in module.cases(quick):
        for name in (name for name in known if names is None or name in names):
            if task not in (known[name].tasks or (task,)) or (record.has(name, case) and not again):
                continue
            found = in_a_process(task, name, case, limit)
            record.add(name, case, found)
            what = next(f"{key}: {found[key]}" for key in ("result", "cannot", "unavailable", "failed") if key in found)
            report(f"{task} {json.dumps(case)} {name}: {what[:240]}")
    return record.rows


def in_a_process(task, name, case, limit):
    command = [sys.executable, "-m", "benchmarks.mosaic.case", json.dumps({"task": task, "solver": name, "case": case})]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return {"failed": f"took more than {limit:g} s"}
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
        return {"failed": f"process ended with {done.returncode}: {last}"[:200]}
    return json.loads(done.stdout.strip().splitlines()[-1])
