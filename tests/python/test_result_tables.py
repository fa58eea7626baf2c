"""The tables of results in README.md and docs are those of the records in docs/results."""

import json
from pathlib import Path

import pytest

from docs import flow_tables, performance_tables, result_tables

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("page", result_tables.PAGES, ids=lambda page: page.name)
def test_the_tables_are_those_of_the_records(page):
    text = page.read_text()
    assert result_tables.TABLE.search(text)
    assert text == result_tables.with_tables(text), "run: python -m docs.result_tables"


def test_the_tables_of_speed_are_those_of_the_records():
    text = performance_tables.PAGE.read_text()
    assert len(performance_tables.TABLE.findall(text)) == len(performance_tables.TABLES)
    assert text == performance_tables.with_tables(text), "run: python -m docs.performance_tables"


@pytest.mark.skipif(not flow_tables.RECORDS.exists(), reason="there are no records of flows yet")
def test_the_tables_of_flows_are_those_of_the_records():
    text = flow_tables.PAGE.read_text()
    assert flow_tables.TABLE.search(text)
    assert text == flow_tables.with_tables(text), "run: python -m docs.flow_tables"


@pytest.mark.parametrize("path", sorted((DOCS / "results").rglob("*.json")), ids=lambda path: path.stem)
def test_a_record_says_where_it_comes_from(path):
    record = json.loads(path.read_text())
    assert record["commit"] and record["command"] and record["versions"]["torch"] and record["machine"]["processor"]
