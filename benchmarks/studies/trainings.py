"""One training of a scene with some of its keys changed, kept as a small record."""

import json
import re
import tempfile
from pathlib import Path

import numpy as np
import torch

from benchmarks.studies import evaluation
from prdp_torch import PRDPController, ToleranceController
from prdp_torch.experiments import records, scenes
from prdp_torch.experiments.networks import make_network
from prdp_torch.experiments.refinement import Refinement, start_from_states
from prdp_torch.experiments.training import train


def variant(name, changes):
    """The scene `name` with the keys of `changes` ("section.key": value) replaced or added."""
    text = scenes.available()[name].read_text()
    for path, value in changes.items():
        section, key = path.split(".")
        line = f"{key} = {json.dumps(value)}"
        start = text.index(f"[{section}]")
        end = text.find("\n[", start)
        body = text[start : end if end >= 0 else len(text)]
        changed, found = re.subn(rf"(?m)^{key} = .*$", line, body)
        text = text.replace(body, changed if found else body.rstrip() + f"\n{line}\n")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.toml"
        path.write_text(text)
        return scenes.load(path)


class _OnLoss(PRDPController):
    """Hears the training loss from a callback; what the trainer tells it, the validation metric, is passed over."""

    def step(self, metric, error=None):
        return False

    def hear(self, interval):
        super().step(interval.loss, error=interval.error)


class PRDPOnLoss(Refinement):
    """PRDP with the settings of the scene, driven by the training loss."""

    def __init__(self, scene):
        super().__init__("prdp_loss", self._attach)
        self._settings = dict(scene.prdp)

    def _attach(self, steppers):
        self._controller = _OnLoss(steppers, **self._settings)
        return self._controller

    def callbacks(self):
        return [lambda interval: self._controller.hear(interval)]


def _following(ratio, adjoint_ratio, start):
    """A tolerance that follows the error, with these settings whatever those of auto are."""

    def attach(steppers):
        if start:
            start_from_states(steppers)
        return ToleranceController(steppers, ratio=ratio, adjoint_ratio=adjoint_ratio)

    return lambda scene: Refinement("following", attach, watches_error=True)


REFINEMENTS = {
    "converged": lambda scene: Refinement.constant(scene.max_iter),
    "prdp": Refinement.prdp,
    "prdp_loss": PRDPOnLoss,
    "auto": lambda scene: Refinement.auto(),
    "direct": lambda scene: Refinement.exact(),
    ".1, .1, start": _following(0.1, 0.1, start=True),
    ".1, .1": _following(0.1, 0.1, start=False),
    ".2, .2, start": _following(0.2, 0.2, start=True),
    ".2, .2": _following(0.2, 0.2, start=False),
}


class Study:
    """Trainings that are kept in a folder; one that is there already is not run again."""

    def __init__(self, folder, report, trainings=None):
        self.folder = records.prepare_folder(folder)
        self.report = report
        self.trainings = trainings  # the folder of networks that `benchmarks.refinement` has trained
        self.rows = []

    def train(self, name, how, seed, changes, keep=()):
        """The row of one training; `keep` names curves of the trainer that the row holds as well."""
        scene = variant(name, changes)
        label = "_".join(
            [
                name,
                re.sub(r"\W+", "_", how),
                *(f"{key.split('.')[1]}{value}" for key, value in changes.items()),
                f"seed{seed}",
            ]
        )
        path = self.folder / f"{label}.json"
        row = records.read(path)
        if row is None or row["text"] != scene.text:
            row = self._row(scene, how, seed, changes, keep)
            records.write_training(path, row)
        self.report(f"{label}: {row['error']:.3e}")
        self.rows.append(row)
        return row

    def _row(self, scene, how, seed, changes, keep):
        network = make_network(scene, seed) if scene.trains_network else None
        refinement = REFINEMENTS[how](scene)
        callbacks = refinement.callbacks() if isinstance(refinement, PRDPOnLoss) else ()
        curves = train(scene, refinement, seed=seed, network=network, callbacks=callbacks)
        errors = curves["metric"][-1:] if network is None else evaluation.validation_errors(scene, network)
        return {
            "scene": scene.name,
            "how": how,
            "seed": seed,
            "changes": changes,
            "text": scene.text,
            "error": float(torch.tensor(errors).mean()),
            "errors": errors,
            "loss": float(torch.tensor(curves["update_loss"][-20:]).mean()),
            "updates": len(curves["update_loss"]),
            "products": sum(curves["operator_applications"]),
            "iterations": sum(curves["iterations"]),
            "budget": sum(curves["budget"]),
            "last_k": curves["max_iter"][-1],
            "seconds": sum(curves["seconds"]),
            "warning": curves.get("warning"),
            "diverged": curves.get("diverged"),
            **{key: [float(f"{value:.4g}") for value in curves[key]] for key in keep},
            **records.environment(),
        }

    def write(self, path):
        """The rows without what the record as a whole says, or the changes give: one commit may have run only some."""
        environment = records.environment()
        left_out = {"text", "fingerprint", *environment} - {"commit"}
        rows = [{key: value for key, value in row.items() if key not in left_out} for row in self.rows]
        for row in rows:
            row["errors"] = [float(f"{error:.4g}") for error in row.get("errors", ())]
        records.write(path, {**environment, "rows": rows})


def saved(rows, converged, count):
    """The share of a cost that is saved, for a table: none is claimed by rows that end worse than the converged ones,
    as `prdp compare` judges it, or whose controllers warn."""
    errors, goal = ([r["error"] for r in these] for these in (rows, converged))
    spread_of_goal = np.std(goal, ddof=1) if len(goal) > 1 else 0.0
    if np.mean(errors) > np.mean(goal) + max(spread_of_goal, 0.1 * np.mean(goal)):
        return "fails"
    warns = sum(r["warning"] is not None for r in rows)
    if warns:
        return f"{warns} of {len(rows)} warn"
    return f"{100 * (1 - np.mean([r[count] for r in rows]) / np.mean([r[count] for r in converged])):.0f} %"
