"""How long corrected flows follow the finer one: `python -m benchmarks.corrected_flow`, after
`python -m benchmarks.refinement kolmogorov`.

Prints the error of each row beside that of the coarse flow alone, over more steps than any training knows, and draws it
to docs/results."""

import argparse
from pathlib import Path

import torch

from benchmarks import refinement
from prdp_torch.experiments import datasets, records, scenes, trajectories, trajectory_charts
from prdp_torch.experiments.charts import write_png

RESULTS = Path(__file__).parents[1] / "docs" / "results"
SHOWN = ("converged", "auto")  # in the picture


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.corrected_flow")
    parser.add_argument("--runs", type=Path, default=Path("runs/kolmogorov-refinement"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    scene = scenes.load("kolmogorov")
    times = [scene.data.trained_steps, *(n * scene.data.valid_steps for n in (1, 2, 4))]
    reference = datasets.reference(scene, times[-1])
    courses = {"coarse": trajectories._follow(scene, "coarse flow alone", "coarse", [torch.zeros_like], reference)}
    for row in refinement.rows_of(scene):
        paths = sorted((options.runs / row.label).glob("seed_*.json"))
        row.curves = [records.read(path)["curves"] for path in paths]
        networks = trajectories._networks(scene, row, options.runs)
        if networks:
            courses[row.label] = trajectories._follow(scene, row.title, row.kind, networks, reference)
    print("error after steps", *times)
    for course in courses.values():
        errors = course.errors[:, [n - 1 for n in times]]
        spread = errors.std(0, ddof=1) if len(errors) > 1 else 0 * errors[0]  # the coarse flow is one run
        print(course.title, *(f"{m:.2e} ± {s:.0e}" for m, s in zip(errors.mean(0), spread, strict=True)))
    shown = trajectories.Trajectories(reference, [courses[label] for label in ("coarse", *SHOWN)], [])
    write_png(trajectory_charts.error_over_time(scene, shown), RESULTS / "kolmogorov_error.png", dpi=70)


if __name__ == "__main__":
    main()
