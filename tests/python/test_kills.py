"""A few of the kills of kills.py, which does a hundred of each."""

import random

import kills
import pytest


@pytest.mark.parametrize("trainer", kills.TRAINERS)
@pytest.mark.parametrize("task", kills.TASKS)
def test_killed_trainings_end_as_those_that_were_left_alone(tmp_path, trainer, task):
    count = kills.kill(trainer, task, 2, tmp_path / task, random.Random(0))
    assert count.kills == 2 and count.runs >= 1 and count.lost == count.damaged == 0
