"""`prdp compare`: the converged solver, the exact one, auto, PRDP and a sweep of constant K, over seeds."""

import functools
import math
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np

from prdp_torch import data_parallel
from prdp_torch.experiments import _C, records
from prdp_torch.experiments.checkpoint import Checkpoint, difference
from prdp_torch.experiments.datasets import OnData
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import Callback, Curves, Interval, train

Entry: TypeAlias = dict[str, Any]
"""A row of the table: what a way of choosing K reached and what it cost."""


@dataclass
class Row:
    """One way of choosing K, over all seeds. Arrays have a leading seed axis."""

    label: str
    title: str
    kind: str  # "converged", "constant", "tolerance", "auto", "prdp", "growth", "schedule", "direct"
    refinement: Refinement
    k: int = 0
    curves: list[Curves] = field(default_factory=list)

    def stack(self, name: str) -> np.ndarray:
        """(seeds, entries) of a curve. Where that of a lost training ends, its metric is NaN, K stays and nothing more
        is counted."""
        curves = self._each(name)
        longest = max(map(len, curves))
        padded = []
        for curve in curves:
            rest = math.nan if name == "metric" else curve[-1] if name == "max_iter" else 0
            padded.append([*curve, *[rest] * (longest - len(curve))])
        return np.array(padded, dtype=float)

    def _each(self, name: str) -> list[list[float]]:
        """A curve of each seed."""
        return [cast(dict[str, list[float]], curves)[name] for curves in self.curves]

    def final(self) -> np.ndarray:
        """Metric at the end, one value a seed."""
        return np.asarray(self.stack("metric")[:, -1])

    def counted(self, target: float | None) -> np.ndarray:
        """Intervals that count, one value a seed: all, or up to where the metric reaches the target."""
        metric = self.stack("metric")[:, 1:]
        if target is None:
            return np.full(len(metric), metric.shape[1])
        reached = metric <= target
        counted: np.ndarray = np.where(reached.any(1), reached.argmax(1) + 1, metric.shape[1])
        return counted

    def total(self, name: str, target: float | None = None) -> np.ndarray:
        """Sum of a cost over the intervals that count, one value a seed."""
        taken = [sum(curve[:n]) for curve, n in zip(self._each(name), self.counted(target), strict=True)]
        return np.array(taken)

    def diverged(self) -> int:
        """How many seeds were lost."""
        return sum(why_lost(c) is not None for c in self.curves)

    @property
    def capped(self) -> bool:
        """Whether a tolerance ends the solves, and K is only a cap."""
        return self.kind in ("auto", "tolerance")

    def last_k(self) -> np.ndarray:
        return self.stack("max_iter")[:, -1]

    def taken_per_solve(self) -> np.ndarray:
        """Iterations that a solve took in the mean, one row a seed and one column an interval; NaN where none
        was run."""
        solves = self.stack("budget") / np.maximum(1.0, self.stack("max_iter"))
        return self.stack("iterations") / np.where(solves > 0, solves, np.nan)

    def warnings(self) -> list[str]:
        """What the controllers said in the end, else that solves still failed, of every seed with something to say."""
        said = [c.get("warning") or _still_failing(c) for c in self.curves]
        return [words for words in said if words]

    def reaches(self, target: float) -> np.ndarray:
        return np.asarray((self.stack("metric") <= target).any(1))


def _still_failing(curves: Curves) -> str | None:
    failed = curves["failed"][-1] if curves.get("failed") else 0
    return f"solves of {failed:,} samples failed in the last interval" if failed else None


def why_lost(curves: Curves) -> str | None:
    """Why a training is lost, or None: its numbers are not finite, or so large that they say nothing else."""
    if "diverged" in curves:
        return curves["diverged"]
    return _C.why_lost(curves["error"][0], curves["error"][-1]) or None


def rows_of(scene: _C.Scene) -> list[Row]:
    """The rows of a scene's comparison: converged first, then the exact solver where it is cheap, a looser tolerance
    where the scene names one, auto, PRDP and constant K."""
    converged = scene.max_iter
    rows = [Row("converged", f"converged, K = {converged}", "converged", Refinement.constant(converged), converged)]
    # All steps of a field's rollout share one operator, and so one factorisation.
    if scene.physics.direct_is_cheap or scene.task == "field":
        rows.append(Row("direct", "direct solver", "direct", Refinement.exact(), 1))
    if scene.compare.rtol is not None:
        tolerance = Refinement.tolerance(scene.compare.rtol, converged)
        rows.append(Row(tolerance.label, f"rtol = {scene.compare.rtol:g}", "tolerance", tolerance))
    rows.append(Row("auto", "auto", "auto", Refinement.auto()))
    rows.append(Row("prdp", "PRDP", "prdp", Refinement.prdp(scene)))
    if scene.compare.growth is not None:
        growth = scene.compare.growth
        rows.append(Row("prdp_growth", f"PRDP, K ← {growth:g} K", "growth", Refinement.prdp(scene, growth)))
    if scene.compare.schedule:
        start, step = scene.compare.schedule
        schedule = Refinement.schedule(start, step, converged)
        rows.append(Row(schedule.label, f"schedule {start} + {step}", "schedule", schedule))
    for k in dict.fromkeys(scene.compare.constant):
        if k != converged:
            rows.append(Row(f"constant_{k}", f"K = {k}", "constant", Refinement.constant(k), k))
    return rows


def run(
    scene: _C.Scene,
    seeds: int,
    folder: Path,
    resume: bool = False,
    progress: Callable[[Row, int, int], None] | None = None,
    on_data: OnData | None = None,
) -> list[Row]:
    """Train every row with every seed, writing a record each; with `resume`, finished ones are read and
    unfinished ones go on from their checkpoints.

    progress: called with (row, seed, intervals done of this training) as it goes.
    on_data: as in `train`.
    """
    report = progress or (lambda *event: None)
    environment = records.environment(scene.device)
    rows = rows_of(scene)
    with records.alone_in([folder / row.label for row in rows]):
        refuse_to_lose(scene, [row.label for row in rows], seeds, folder, environment, resume)
        for row in rows:
            for seed in range(seeds):

                def show(interval: Interval, row: Row = row, seed: int = seed) -> None:
                    report(row, seed, interval.number)

                row.curves.append(
                    run_one(scene, row.label, row.refinement, seed, folder, environment, resume, [show], on_data)
                )
                report(row, seed, scene.training.intervals)
    return rows


def run_one(
    scene: _C.Scene,
    label: str,
    refinement: Refinement,
    seed: int,
    folder: Path,
    environment: dict[str, Any],
    resume: bool = False,
    callbacks: Iterable[Callback] = (),
    on_data: OnData | None = None,
) -> Curves:
    """One training with its record, and beside it the final weights, of a network or θ, `seed_N.pt`; if `resume`,
    the curves of a finished record of the same settings, or the training goes on from its checkpoint. ValueError for
    a record of the same settings and another number of intervals, which would be lost."""
    path, checkpoint = _files_of(scene, label, seed, folder, environment)
    path.parent.mkdir(parents=True, exist_ok=True)
    if data_parallel.is_first():
        _C.settle_weights(path)
    if not resume:
        checkpoint.remove()
    curves = data_parallel.from_first(lambda: _finished(path, scene, checkpoint)) if resume else None
    if curves is not None:
        return curves
    network = make_network(scene, seed)
    curves = train(scene, refinement, seed, network, callbacks, on_data, checkpoint)
    record = {"label": label, "seed": seed, "settings": records.settings(scene), **environment, "curves": curves}
    if scene.network.python:
        record["folder"] = str(Path(scene.path).resolve().parent)  # where load_trained finds the class again
    records.write_training(path, record, network)
    checkpoint.remove()
    return curves


def refuse_to_lose(
    scene: _C.Scene, labels: Iterable[str], seeds: int, folder: Path, environment: dict[str, Any], resume: bool
) -> None:
    """ValueError where one of these trainings would overwrite a checkpoint: of other settings, or of its own where it
    begins anew. Finished records that will be replaced are told on stderr."""
    replaced = []
    for label in labels:
        for seed in range(seeds):
            path, checkpoint = _files_of(scene, label, seed, folder, environment)
            data_parallel.from_first(functools.partial(checkpoint.refuse_other, path))
            if not resume:
                data_parallel.from_first(functools.partial(checkpoint.refuse_to_lose, path))
            replaced += data_parallel.from_first(functools.partial(_replaced, path, scene, resume))
    if replaced and data_parallel.is_first():
        others = f", and {len(replaced) - 1} more" if len(replaced) > 1 else ""
        print(f"prdp: replaces when it ends: {replaced[0]}{others}", file=sys.stderr)


def _replaced(path: Path, scene: _C.Scene, resume: bool) -> list[str]:
    """The finished record at a path, if this training writes its own over it, and how the two differ."""
    try:
        record = records.read_training(path)
    except ValueError:  # with --resume, who reads it says so
        return [] if resume else [f"'{path}', which is damaged"]
    if record is None:
        return []
    there, here = record["settings"], records.settings(scene)
    if there == here:
        return [] if resume else [f"'{path}', of the same settings"]
    same = {**there, "intervals": here["intervals"]} == here
    return [] if resume and same else [f"'{path}' ({difference(there, here)})"]


def _files_of(
    scene: _C.Scene, label: str, seed: int, folder: Path, environment: dict[str, Any]
) -> tuple[Path, Checkpoint]:
    """The record of a training, and its checkpoint."""
    record = folder / label / f"seed_{seed}.json"
    path, settings, versions = record.with_suffix(".checkpoint"), records.identity(scene), environment["versions"]
    return record, Checkpoint(path, label=label, seed=seed, settings=settings, versions=versions)


def _finished(path: Path, scene: _C.Scene, checkpoint: Checkpoint) -> Curves | None:
    """The curves of the record at `path` if it is of this training, and its weights are there. ValueError if they are
    damaged, or if it is of another length, and no checkpoint is left to go on from."""
    record = records.read_training(path)
    if record is None:
        return None
    intervals = record["settings"].pop("intervals")
    if record["settings"] != records.identity(scene):
        return None
    if intervals == scene.training.intervals:
        if "weights" in record and _C.read_weights(path, record["weights"]) is None:
            return None
        checkpoint.remove_before(path)
    else:
        if not checkpoint.find():
            _C.refuse_finished(path, intervals, scene.training.intervals)
        return None
    curves: Curves = record["curves"]
    return curves


def summarise(scene: _C.Scene, rows: list[Row]) -> list[Entry]:
    """The table of a comparison: one dict a row, means over seeds and the values of each; savings against the first
    row."""
    target = scene.compare.target
    table = [_entry(scene, row, target) for row in rows]
    judge(table, table[0])
    return table


def judge(table: list[Entry], base: Entry) -> None:
    """Write into each entry whether it ends as well as `base`, and what it saves of it."""
    for entry in table:
        entry["as_good"] = _as_good(entry, base)
        # A cap on K is no allowance; the products are everybody's.
        entry["saved"] = None if entry["capped"] else 1 - entry["budget"] / max(1.0, base["budget"])
        entry["products_saved"] = 1 - entry["operator_applications"] / max(1.0, base["operator_applications"])


def _entry(scene: _C.Scene, row: Row, target: float | None) -> Entry:
    final = row.final()
    costs = ("budget", "iterations", "operator_applications", "adjoint_applications")
    warnings = row.warnings()
    return {
        "label": row.label,
        "title": row.title,
        "kind": row.kind,
        "capped": row.capped,
        "seeds": len(row.curves),
        "diverged": row.diverged(),
        "warnings": len(warnings),
        "warning": warnings[0] if warnings else None,
        "metric": float(final.mean()),
        "metric_std": float(final.std(ddof=1)) if len(final) > 1 else 0.0,
        "last_k": float((row.taken_per_solve()[:, -1] if row.capped else row.last_k()).mean()),
        "intervals": float(row.counted(target).mean()),
        "reaches_target": None if target is None else bool(row.reaches(target).all()),
        "saved_by_incomplete_convergence": float(max(0.0, 1 - row.last_k().mean() / scene.max_iter)),
        **{cost: float(row.total(cost, target).mean()) for cost in costs},
        # Of the first training in a fresh clone, most may be the wait for the disk.
        "seconds": float(np.median(row.total("seconds", target))),
        "each": {
            "metric": final.tolist(),
            **{cost: row.total(cost, target).tolist() for cost in ("operator_applications", "seconds")},
        },
    }


def verdict(entry: Entry) -> str:
    """Why a row saves nothing: it "fails", or its controller "warns"; else empty."""
    if not entry["as_good"]:
        return "fails"
    return "warns" if entry["warning"] else ""


def _as_good(entry: Entry, base: Entry) -> bool:
    """Whether a row ends as well as the converged one: at its target where both have one to reach, else
    within its spread. A tenth of the error counts as its spread where seeds show less."""
    if entry["diverged"] or not math.isfinite(base["metric"]):
        return not entry["diverged"]
    if entry["reaches_target"] is not None and base["reaches_target"]:
        return bool(entry["reaches_target"])
    return bool(entry["metric"] <= base["metric"] + max(base["metric_std"], 0.1 * base["metric"]))
