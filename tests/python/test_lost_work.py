"""What the command `prdp` does not pass over in silence: trainings that are lost, and records that it replaces."""

import json

import pytest
from helpers import written
from typer.testing import CliRunner

from prdp_torch.experiments import cli


def prdp(*arguments):
    """Exit status, and what was said on stderr."""
    done = CliRunner().invoke(cli.app, list(map(str, arguments)))
    return done.exit_code, done.stderr


@pytest.mark.parametrize(
    "rate, why",
    [
        ("1e17", "its relative error is "),  # finite in float64
        ("1e300", "interval 1: the metric is "),
        ("1e-3", None),
    ],
)
def test_a_training_that_ends_nowhere_is_exit_1_with_its_record(tmp_path, rate, why):
    changes = ("float32", "float64"), ("learning_rate = 1e-3", f"learning_rate = {rate}"), ("train = 200", "train = 20")
    scene = written(tmp_path, *changes)
    status, said = prdp("train", scene, "--intervals", 2, "--out", tmp_path)
    assert status == (0 if why is None else 1)
    assert why is None or f"prdp: seed 0 diverged, {why}" in said
    curves = json.loads((tmp_path / "auto/seed_0.json").read_text())["curves"]
    assert why is None or curves["metric"][-1] is None or curves["metric"][-1] > 1e20
