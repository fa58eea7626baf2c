"""`python -m benchmarks.studies NAME`: run a study, or go on with it; write its table, chart and record."""

import argparse
import contextlib
import importlib
import sys
from pathlib import Path

STUDIES = ("data", "inference", "loss", "precision", "residuals", "unroll", "updates", "widths")


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.studies", description=__doc__)
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/studies"))
    parser.add_argument("--quick", action="store_true", help="the smallest part, to see that it runs")
    options = parser.parse_args()
    from benchmarks.studies.trainings import Study
    from prdp_torch.experiments.charts import write_png

    module = importlib.import_module(f"benchmarks.studies.{options.study}")
    study = Study(options.out / options.study, lambda text: print(text, file=sys.stderr, flush=True))
    with contextlib.suppress(KeyboardInterrupt):  # what is done is written
        module.run(study, options.seeds, options.quick)
    study.write(options.out / f"{options.study}.json")
    write_png(module.chart(study.rows), options.out / f"{options.study}.png", dpi=110)
    print(module.table(study.rows))


if __name__ == "__main__":
    main()
