"""`prdp compare`: the converged solver, the exact one, PRDP and a sweep of constant K, over seeds."""

import math
from dataclasses import dataclass, field

import numpy as np

from prdp_torch import _C, records
from prdp_torch.checkpoint import Checkpoint
from prdp_torch.networks import make_network
from prdp_torch.training import Refinement, train


@dataclass
class Row:
    """One way of choosing K, over all seeds. Arrays have a leading seed axis."""

    label: str
    title: str
    kind: str  # "converged", "constant", "prdp", "growth", "schedule", "direct"
    refinement: Refinement
    k: int = 0
    curves: list = field(default_factory=list)

    def stack(self, name):
        """(seeds, entries) of a curve. Where that of a lost training ends, its metric is NaN, K stays and nothing more
        is counted."""
        longest = max(len(c[name]) for c in self.curves)
        rest = {"metric": lambda values: math.nan, "max_iter": lambda values: values[-1]}.get(name, lambda values: 0)
        padded = [[*c[name], *[rest(c[name])] * (longest - len(c[name]))] for c in self.curves]
        return np.array(padded, dtype=float)

    def final(self):
        """Metric at the end, one value a seed."""
        return self.stack("metric")[:, -1]

    def counted(self, target):
        """Intervals that count, one value a seed: all, or up to where the metric reaches the target."""
        metric = self.stack("metric")[:, 1:]
        if target is None:
            return np.full(len(metric), metric.shape[1])
        reached = metric <= target
        return np.where(reached.any(1), reached.argmax(1) + 1, metric.shape[1])

    def total(self, name, target=None):
        """Sum of a cost over the intervals that count, one value a seed."""
        return np.array([sum(c[name][:n]) for c, n in zip(self.curves, self.counted(target), strict=True)])

    def diverged(self):
        """How many seeds were lost."""
        return sum("diverged" in c for c in self.curves)

    def last_k(self):
        return self.stack("max_iter")[:, -1]

    def reaches(self, target):
        return (self.stack("metric") <= target).any(1)


def rows_of(scene):
    """The rows of a scene's comparison: converged first, then the exact solver where it is cheap, PRDP, constant K."""
    converged = scene.max_iter
    rows = [Row("converged", f"converged, K = {converged}", "converged", Refinement.constant(converged), converged)]
    if scene.physics.direct_is_cheap:
        rows.append(Row("direct", "direct solver", "direct", Refinement.exact(), 1))
    rows.append(Row("prdp", "PRDP", "prdp", Refinement.prdp(scene)))
    if scene.compare.growth is not None:
        growth = scene.compare.growth
        rows.append(Row("prdp_growth", f"PRDP, K ← {growth:g} K", "growth", Refinement.prdp(scene, growth)))
    if scene.compare.schedule:
        start, step = scene.compare.schedule
        schedule = Refinement.schedule(start, step, converged)
        rows.append(Row(schedule.label, f"schedule {start} + {step}", "schedule", schedule))
    for k in scene.compare.constant:
        if k != converged:
            rows.append(Row(f"constant_{k}", f"K = {k}", "constant", Refinement.constant(k), k))
    return rows


def run(scene, seeds, folder, resume=False, progress=None, on_data=None):
    """Train every row with every seed, writing a record each; with `resume`, finished ones are read and
    unfinished ones go on from their checkpoints.

    progress: called with (row, seed, intervals done of this training) as it goes.
    on_data: as in `train`.
    """
    report = progress or (lambda *event: None)
    environment = records.environment()
    rows = rows_of(scene)
    with records.alone_in([folder / row.label for row in rows]):
        for row in rows:
            for seed in range(seeds):
                row.curves.append(
                    run_one(
                        scene,
                        row.label,
                        row.refinement,
                        seed,
                        folder,
                        environment,
                        resume,
                        lambda done, metric, k, row=row, seed=seed: report(row, seed, done),
                        on_data,
                    )
                )
    return rows


def run_one(scene, label, refinement, seed, folder, environment, resume, on_interval, on_data=None):
    """One training with its record, and beside it the final weights of a network, `seed_N.pt`; if `resume`,
    the curves of a finished record of the same settings, or the training goes on from its checkpoint. ValueError for
    a record of the same settings and another number of intervals, which would be lost."""
    path = folder / label / f"seed_{seed}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    versions = environment["versions"]
    checkpoint = Checkpoint(
        path.with_suffix(".checkpoint"), label=label, seed=seed, settings=records.identity(scene), versions=versions
    )
    if not resume:
        checkpoint.remove()
    curves = _finished(path, scene, checkpoint) if resume else None
    if curves is not None:
        on_interval(scene.training.intervals, curves["metric"][-1], curves["max_iter"][-1])
        return curves
    network = None if scene.task == "parameters" else make_network(scene, seed)
    curves = train(scene, refinement, seed, network, on_interval, on_data, checkpoint)
    on_interval(scene.training.intervals, curves["metric"][-1], curves["max_iter"][-1])
    record = {"label": label, "seed": seed, "settings": records.settings(scene), **environment, "curves": curves}
    records.write_training(path, record, network)
    checkpoint.remove()
    return curves


def _finished(path, scene, checkpoint):
    """The curves of the record at `path` if it is of this training. ValueError if it is of another length, and no
    checkpoint is left to go on from."""
    record = records.read(path)
    if record is None:
        return None
    intervals = record["settings"].pop("intervals")
    if record["settings"] != records.identity(scene):
        return None
    if intervals != scene.training.intervals:
        if checkpoint.read() is None:
            _C.refuse_finished(path, intervals, scene.training.intervals)
        return None
    curves = record["curves"]
    curves["metric"] = [math.nan if value is None else value for value in curves["metric"]]
    return curves


def summarise(scene, rows):
    """The table of a comparison: one dict a row, means over seeds; savings against the first row."""
    target = scene.compare.target
    base = max(1.0, rows[0].total("budget", target).mean())  # a run that diverged at once has none
    table = []
    for row in rows:
        final = row.final()
        budget = row.total("budget", target).mean()
        table.append(
            {
                "label": row.label,
                "title": row.title,
                "kind": row.kind,
                "diverged": row.diverged(),
                "metric": float(final.mean()),
                "metric_std": float(final.std(ddof=1)) if len(final) > 1 else 0.0,
                "last_k": float(row.last_k().mean()),
                "intervals": float(row.counted(target).mean()),
                "reaches_target": None if target is None else bool(row.reaches(target).all()),
                "budget": float(budget),
                "saved": float(1 - budget / base),
                "saved_by_incomplete_convergence": float(max(0.0, 1 - row.last_k().mean() / scene.max_iter)),
                "iterations": float(row.total("iterations", target).mean()),
                "operator_applications": float(row.total("operator_applications", target).mean()),
                "seconds": float(row.total("seconds", target).mean()),
            }
        )
    return table
