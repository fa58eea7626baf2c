"""What the tests of checkpoints share: small trainings that write one after every interval."""

import pytest
from helpers import small_field, tiny, written


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
