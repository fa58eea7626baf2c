"""What the tests of checkpoints share: small trainings that write one after every interval."""

import pytest
import torch
from helpers import small_field, tiny, written

from prdp_torch import PRDPController
from prdp_torch.experiments.checkpoint import Checkpoint

CURVES = (
    "update_loss", "metric", "error", "max_iter", "budget", "iterations", "operator_applications",
    "adjoint_applications", "rtol", "failed", "seconds",
)  # fmt: skip


@pytest.fixture(autouse=True)
def frequent_checkpoints(tmp_path, monkeypatch):
    monkeypatch.setenv("PRDP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # of programs
    monkeypatch.setenv("PRDP_CHECKPOINT_SECONDS", "0")


def scene_of(task, tmp_path):
    """The path of a scene of this task."""
    if task == "corrector":
        return tiny(tmp_path)
    if task == "field":
        return small_field(tmp_path)
    return written(tmp_path, scene={"emulator": "heat_1d", "parameters": "poisson_1p"}[task])


def without_seconds(curves):
    return {name: values for name, values in curves.items() if name != "seconds"}


def checkpoint_of(path, **settings):
    """A checkpoint for `state`."""
    return Checkpoint(path, **{"seed": 0, **settings})


def state(number, *tensors):
    """What `Checkpoint.save` takes after one interval: a number, and whatever else."""
    controller = PRDPController()
    controller.step(1.0)
    controller.step(1.0)
    whole = {"max_iter", "budget", "failed"}
    curves = {name: [1 if name in whole else 1.0] * (1 + (name in ("metric", "error"))) for name in CURVES}
    named = {f"tensor{i}": tensor for i, tensor in enumerate(tensors)}
    return {"theta": torch.tensor(float(number)), **named}, curves, controller.state_dict()


def restored(checkpoint):
    """The number of the state that a trainer goes on from; None where there is no checkpoint."""
    numbers = []

    def load(saved):
        numbers.append(float(saved.take("theta", torch.zeros(())).item()))
        saved.progress(1)

    return numbers[-1] if checkpoint.restore(checkpoint.find(), load) else None
