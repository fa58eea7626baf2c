"""The tables and figures of README.md and docs are those of the records."""

import json
import re
from pathlib import Path

import pytest

from benchmarks.studies.trainings import saved
from docs import baseline_tables, figures, flow_tables, performance_tables, record_rows, record_tables, result_tables

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("page", result_tables.PAGES, ids=lambda page: page.name)
def test_the_tables_are_those_of_the_records(page):
    text = page.read_text()
    assert result_tables.TABLE.search(text)
    assert text == result_tables.with_tables(text), "run: python -m docs.result_tables"


def test_every_table_and_every_study_is_on_one_page():
    shown = [found[2] for page in result_tables.PAGES for found in result_tables.TABLE.finditer(page.read_text())]
    studies = {f"the study of {path.stem}" for path in (DOCS / "results" / "studies").glob("*.json")}
    assert len(shown) == len(set(shown)) and {*result_tables.TABLES, *studies} <= set(shown)


def test_the_tables_of_speed_are_those_of_the_records():
    texts = [path.read_text() for path in performance_tables.PAGES]
    shown = [found[2] for text in texts for found in performance_tables.TABLE.finditer(text)]
    assert sorted(shown) == sorted(performance_tables.TABLES)
    assert texts == [performance_tables.with_tables(text) for text in texts], "run: python -m docs.performance_tables"


@pytest.mark.parametrize("page", flow_tables.PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_the_tables_of_flows_are_those_of_the_records(page):
    text = page.read_text()
    assert flow_tables.TABLE.search(text)
    assert text == flow_tables.with_tables(text), "run: python -m docs.flow_tables"


def test_the_table_of_records_is_that_of_the_records():
    text = record_tables.PAGE.read_text()
    assert len(record_tables.TABLE.findall(text)) == 1
    assert text == record_tables.with_tables(text), "run: python -m docs.record_tables"


def a_row(**changes):
    row = {"as_good": True, "warnings": 0, "warning": None, "seeds": 3, "diverged": 0, "kind": "prdp", "seconds": 5.0}
    row |= {"products_saved": 0.5, "metric": 0.1, "metric_std": 0.0, "reaches_target": None, "error": 0.1, "budget": 5}
    return row | changes


def test_a_row_that_fails_or_warns_claims_no_saving():
    assert [record_rows.claim(row, 0.5) for row in (a_row(), a_row(warnings=1), a_row(as_good=False))] == [
        "50 %", "warns", "fails",
    ]  # fmt: skip
    assert record_rows.claim(a_row(as_good=False, warnings=3), 0.5) == "fails"
    base = a_row(seconds=10.0)
    times = [a_row(), a_row(seconds=8.0), a_row(seconds=12.0), a_row(seconds=15.0), a_row(as_good=False)]
    assert [record_rows.time_saved(row, base) for row in times] == ["50 %", "none", "none", "−50 %", "fails"]


def test_an_error_says_how_many_of_its_seeds_warn():
    assert record_rows.error(a_row(warnings=1, seeds=10)) == "1.00e-01, 1 of 10 warn"
    assert record_rows.error(a_row(warnings=1, seeds=1)) == "1.00e-01, warns"


def test_a_study_claims_no_saving_of_trainings_that_fail_or_warn():
    converged = [a_row(budget=10) for _ in range(3)]
    assert saved([a_row() for _ in range(3)], converged, "budget") == "50 %"
    assert saved([a_row(error=0.12) for _ in range(3)], converged, "budget") == "fails"
    assert saved([a_row(), a_row(), a_row(warning="too far off")], converged, "budget") == "1 of 3 warn"


@pytest.mark.parametrize("page", result_tables.PAGES, ids=lambda page: page.name)
def test_no_line_of_a_table_claims_what_it_warns_of(page):
    """Of the tables with one way of choosing K per line; those with more have a cell for each."""
    for found in result_tables.TABLE.finditer(page.read_text()):
        if found[2] in ("time and products", "the study of widths"):
            continue
        for line in found[0].splitlines():
            cells = [cell.strip() for cell in line.split("|")]
            if found[2] in ("seconds", "the scenes beside the paper"):
                del cells[5:6]  # PRDP, beside what auto saves; what the paper saves
            if re.search(r"\bwarns?\b|\bfails\b|not reached|diverged", "|".join(cells)):
                assert not [cell for cell in cells if re.fullmatch(r"−?[\d.]+ %", cell)], line


def test_the_figures_in_the_prose_are_those_of_the_records():
    pages = {path.name for path in figures.PAGES}
    assert {"results.md", "questions.md", "three_scenes.md"} <= pages
    for path in figures.PAGES:
        text = path.read_text()
        assert text == figures.with_figures(text), f"{path.name}: run: python -m docs.figures"


def test_the_strongest_rows_are_the_fastest_that_claim_something():
    table = baseline_tables.seconds().splitlines()
    (line,) = (line for line in table if line.startswith("| diffusion_inverse_256, "))
    assert "(multigrid, " in line and "fails" not in line
    found = [a_row(label="rtol_0.1", warnings=1, operator_applications=1)]
    assert baseline_tables._loosest(found) is None
    found += [a_row(label=f"rtol_{rtol}", operator_applications=n) for rtol, n in ((0.001, 30), (0.01, 20))]
    assert baseline_tables._power_of(baseline_tables._loosest(found)) == "1e-2"


@pytest.mark.parametrize("path", sorted((DOCS / "results").rglob("*.json")), ids=lambda path: path.stem)
def test_a_record_says_where_it_comes_from(path):
    record = json.loads(path.read_text())
    assert record["commit"] and record["command"] and record["versions"]["torch"] and record["machine"]["processor"]
