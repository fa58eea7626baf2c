"""The tables of results in README.md and docs are those of the records in docs/results."""

import importlib.util
import json
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


def script():
    spec = importlib.util.spec_from_file_location("result_tables", DOCS / "result_tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", script().PAGES, ids=lambda page: page.name)
def test_the_tables_are_those_of_the_records(page):
    module = script()
    text = page.read_text()
    assert module.TABLE.search(text)
    assert text == module.with_tables(text), "run: python docs/result_tables.py"


@pytest.mark.parametrize("path", sorted((DOCS / "results").rglob("*.json")), ids=lambda path: path.stem)
def test_a_record_says_where_it_comes_from(path):
    record = json.loads(path.read_text())
    assert record["commit"] and record["command"] and record["versions"]["torch"] and record["machine"]["processor"]
