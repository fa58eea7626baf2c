"""`python -m benchmarks.studies NAME`: run a study, or go on with it; write its table, chart and record."""

import argparse
import contextlib
import importlib
import sys
from functools import partial
from pathlib import Path

STUDIES = ("data", "inference", "loss", "precision", "ratios", "residuals", "unroll", "updates", "widths")


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.studies", description=__doc__)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/studies"))
    parser.add_argument("--quick", action="store_true", help="the smallest part, to see that it runs")
    parser.add_argument(
        "--trainings", type=Path, default=Path("runs/navier_stokes-refinement"),
        help="what 'benchmarks.refinement navier_stokes' has trained, for inference",
    )  # fmt: skip
    options = parser.parse_args()
    from benchmarks.studies.trainings import Study
    from prdp_torch.experiments.charts import write_png

    module = importlib.import_module(f"benchmarks.studies.{options.study}")
    report = partial(print, file=sys.stderr, flush=True)
    study = Study(options.out / options.study, report, options.trainings)
    with contextlib.suppress(KeyboardInterrupt):  # what is done is written
        module.run(study, options.seeds, options.quick)
    study.write(options.out / f"{options.study}.json")
    write_png(module.chart(study.rows), options.out / f"{options.study}.png", dpi=110)
    print(module.table(study.rows))


if __name__ == "__main__":
    main()
