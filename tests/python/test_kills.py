"""A few of the kills of kills.py, which does a hundred of each."""

import json
import random
from pathlib import Path

import kills
import kills_at_renames
import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("trainer", kills.TRAINERS)
@pytest.mark.parametrize("task", kills.TASKS)
def test_killed_trainings_end_as_those_that_were_left_alone(tmp_path, trainer, task):
    count = kills.kill(trainer, task, 2, tmp_path / task, random.Random(0))
    assert count.kills == 2 and count.runs >= 1 and count.lost == count.damaged == 0


@pytest.mark.parametrize("trainer", kills.TRAINERS)
def test_trainings_that_are_killed_between_two_renames_lose_nothing(tmp_path, trainer):
    places = len(kills_at_renames.PLACES)
    count = kills_at_renames.kill(trainer, places, tmp_path / "here", random.Random(1))
    assert (count.kills, count.lost, count.damaged) == (places, 0, 0)


def test_a_row_takes_the_place_of_its_like_and_leaves_the_others(tmp_path):
    for number, task in enumerate(["field", "emulator", "field"]):
        kills.keep(tmp_path / "kills.json", {"trainer": "cpp", "task": task, "kills": number})
    assert [row["kills"] for row in json.loads((tmp_path / "kills.json").read_text())] == [1, 2]


def test_the_docs_say_what_the_record_holds():
    rows = json.loads((DOCS / "stability" / "kills.json").read_text())
    tasks = [*kills.TASKS, kills.AT_RENAMES]
    assert {(row["trainer"], row["task"]) for row in rows} == {(n, t) for n in kills.TRAINERS for t in tasks}
    assert {row["kills"] for row in rows} == {100} and not any(row["lost"] or row["damaged"] for row in rows)
    total, with_files = (sum(row[key] for row in rows) for key in ("kills", "in_training"))
    said = f"Of these {total} kills, {with_files} came when a checkpoint or a record was there"
    assert said in (DOCS.parent / "CONTRIBUTING.md").read_text()
