"""A few of the forged files of forgeries.py, which tries ten thousand."""

import json
from pathlib import Path

import forgeries
import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    monkeypatch.setenv("PRDP_CACHE", "")  # the forgery of cached data sets it
    for name, value in forgeries.SETTINGS.items():
        monkeypatch.setenv(name, value)


@pytest.mark.parametrize("kind", forgeries.KINDS)
def test_forged_files_are_refused_in_words_or_passed_over(tmp_path, kind):
    count = 15 if "C++" in kind else 40
    outcomes, faults = forgeries.attack(kind, count, tmp_path / "here", seed=1)
    assert not faults and outcomes[forgeries.REFUSED] + outcomes[forgeries.BEFORE] > count / 4


def test_the_docs_say_what_the_record_holds():
    rows = json.loads((DOCS / "stability" / "forgeries.json").read_text())
    assert [row["files"] for row in rows] == list(forgeries.KINDS) and not any(row["faults"] for row in rows)
    forged, taken = (sum(row[name] for row in rows) for name in ("forged", forgeries.TAKEN))
    assert forged == 10_000 and f"| forged files | {forged:,}" in (DOCS.parent / "CONTRIBUTING.md").read_text()
    assert f"{taken:,} were taken" in (DOCS.parent / "CONTRIBUTING.md").read_text()
