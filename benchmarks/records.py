"""`make records`: make the records of docs/ again, in this order, and then their pictures and tables.

Run it on an idle machine, on a clean commit. What was made on this commit is not made again, so the command goes on
where it stopped. `python -m benchmarks.records --list` prints the list; NAMES choose some of it."""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from prdp_torch.experiments import records

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "runs" / "records"
TABLES = ("result", "performance", "flow", "record")


class Made(NamedTuple):
    """A command, how many minutes it takes on one core of an AMD EPYC of the third to fifth Zen generation, and which
    of its files go where."""

    name: str
    command: str  # {made} stands for the folder where the records of this commit are made
    minutes: int
    made: str  # in the folder of the command
    kept: str  # in docs

    def shown(self):
        return " ".join(f"python {self.command}".replace("{made}", "runs/records/COMMIT").split())


def refinement(scene, seeds, minutes, rows="", name=None):
    command = f"-m benchmarks.refinement {scene} --seeds {seeds} {rows} --resume"
    name = name or scene
    return Made(f"refinement_{name}", command, minutes, "summary.json", f"results/refinement_{name}.json")


def comparison(scene, seeds, minutes, backward=None):
    name = f"{scene}_{backward}" if backward else scene
    options = f"--backward {backward}" if backward else f"--seeds {seeds}"
    command = f"-m prdp_torch compare {scene} {options} --resume"
    return Made(name, command, minutes, "summary.json", f"results/{name}.json")


def study(name, options, minutes):
    return Made(
        name, f"-m benchmarks.studies {name} {options}", minutes, f"{name}.json", f"results/studies/{name}.json"
    )


def suite(name, minutes):
    return Made(name, f"-m benchmarks {name}", minutes, f"{name}.json", f"performance/{name}.json")


LIST = [
    *(comparison(f"poisson_{which}", 1, 1, way) for which in ("1p", "3p", "3p_sd") for way in ("implicit", "unrolled")),
    comparison("heat_1d", 10, 3),
    comparison("burgers_1d", 10, 40),
    comparison("burgers_2d", 3, 10),
    comparison("heat_2d", 3, 40),
    comparison("diffusion_inverse", 10, 3),
    *(refinement(f"poisson_{which}", 1, 1) for which in ("1p", "3p", "3p_sd")),
    refinement("heat_1d", 10, 3),
    refinement("burgers_1d", 10, 90),
    refinement("burgers_2d", 3, 55),
    refinement(
        "benchmarks/scenes/burgers_2d_192.toml",
        3,
        150,
        "--rows converged prdp auto rtol_0.1 rtol_0.01 multigrid auto_multigrid multigrid_rtol_0.01",
        name="burgers_2d_192",
    ),
    refinement("heat_2d", 3, 60),
    refinement("diffusion_inverse", 10, 5),
    refinement("benchmarks/scenes/diffusion_inverse_256.toml", 3, 90, name="diffusion_inverse_256"),
    refinement("kolmogorov", 3, 20),
    Made(
        "heat_3d",
        "-m benchmarks.refinement heat_3d --rows converged prdp auto multigrid auto_multigrid --resume",
        150,
        "summary.json",
        "results/heat_3d.json",
    ),
    refinement("navier_stokes", 3, 600, "--rows converged prdp auto none rtol_0.1 rtol_0.01 rtol_0.001 rtol_0.0001"),
    study("data", "--seeds 5", 60),
    study("inference", "--trainings {made}/refinement_navier_stokes", 60),
    study("loss", "--seeds 10", 10),
    study("precision", "--seeds 1", 60),
    study("ratios", "--seeds 10", 45),
    study("residuals", "", 1),
    study("unroll", "--seeds 2", 120),
    study("updates", "--seeds 1", 120),
    study("widths", "--seeds 3", 3),
    *(suite(name, 5) for name in ("accuracy", "diffusion", "size", "large", "roofline")),
    *(suite(name, 5) for name in ("change_of_k", "training", "memory")),
    *(
        Made(f"mosaic_{task}", f"-m benchmarks.mosaic {task} --limit 150", 60, f"{task}.json", f"flows/{task}.json")
        for task in ("forward", "cost", "gradient", "horizon", "design", "recovery", "conduction")
    ),
    Made("atlas", "-m benchmarks.atlas", 1, "*", "stability"),
]


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.records", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="of the list; all where none is given")
    parser.add_argument("--list", action="store_true", help="print the list")
    parser.add_argument("--dirty", action="store_true", help="also with changes that are not committed: records say so")
    options = parser.parse_args()
    known = [entry.name for entry in LIST]
    for name in options.names:
        if name not in known:
            parser.error(f"unknown record '{name}'; allowed: {', '.join(known)}")
    chosen = [entry for entry in LIST if not options.names or entry.name in options.names]
    if options.list:
        print("\n".join(f"{e.name:32} {e.minutes:4} min  {e.shown()}" for e in chosen))
        return
    commit = records.environment()["commit"]
    if commit is None or (commit.endswith("-dirty") and not options.dirty):
        parser.error("there are changes that are not committed: commit them, or pass --dirty")
    for entry in chosen:
        make(entry, commit)
    for entry in chosen:  # only now: a changed file in docs would mark the records after it as made on a dirty tree
        keep(entry, commit)
    for script in ("benchmarks.pictures", *(f"docs.{kind}_tables" for kind in TABLES), "docs.figures"):
        subprocess.run([sys.executable, "-m", script], cwd=ROOT, check=True)


def make(entry, commit):
    folder = RUNS / commit / entry.name
    done = folder / ".done"
    if not done.exists():
        print(f"{entry.name}: some {entry.minutes} minutes", flush=True)
        command = entry.command.replace("{made}", str(folder.parent.relative_to(ROOT))).split()
        subprocess.run([sys.executable, *command, "--out", folder.relative_to(ROOT)], cwd=ROOT, check=True)
        done.touch()


def keep(entry, commit):
    target = ROOT / "docs" / entry.kept
    for path in (RUNS / commit / entry.name).glob(entry.made):
        if path.name != ".done":
            shutil.copy(path, target / path.name if target.is_dir() else target)


if __name__ == "__main__":
    main()
