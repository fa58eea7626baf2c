"""`python -m benchmarks.mosaic [TASK …]`: run the tasks on every solver, or go on with them; write records and charts.

Every case runs in a process of its own, on one core. The record of a task is OUT/TASK.json. A case that is in it is not
run again, unless --again is given."""

import argparse
import sys
from pathlib import Path

from benchmarks.__main__ import peer_versions
from benchmarks.mosaic import charts, runner, solvers, tables, tasks
from prdp_torch.experiments import records


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mosaic", description=__doc__)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"{', '.join(tasks.NAMES)}; all.")
    names = list(dict.fromkeys([*solvers.FLOWS, *solvers.CONDUCTION]))
    parser.add_argument("--solvers", nargs="+", choices=names, help="all, where this is not given")
    parser.add_argument("--quick", action="store_true", help="a few small cases, to see that all of it runs")
    parser.add_argument("--again", action="store_true", help="run cases again that are in the record")
    parser.add_argument("--limit", type=float, default=1800.0, metavar="S", help="seconds for one case")
    parser.add_argument("--out", type=Path, help="runs/mosaic, or runs/mosaic_quick with --quick")
    options = parser.parse_args()
    for task in options.tasks:
        if task not in tasks.NAMES:
            parser.error(f"unknown task '{task}'; allowed: {', '.join(tasks.NAMES)}")
    folder = records.prepare_folder(options.out or Path("runs") / ("mosaic_quick" if options.quick else "mosaic"))
    environment = records.environment() | {"peers": peer_versions()}
    environment["machine"]["threads"] = 1  # of every case
    for task in options.tasks or tasks.NAMES:
        rows = runner.run(
            task, options.solvers, folder, environment, options.quick, options.again, options.limit,
            lambda text: print(text, file=sys.stderr, flush=True),
        )  # fmt: skip
        for name, figure in charts.of(task, rows).items():
            figure.savefig(folder / f"{name}.png", dpi=130)
        for title, table in tables.of(task, rows).items():
            print(f"{title}\n\n{table}")


if __name__ == "__main__":
    main()
