"""The Python code of the documentation runs as printed, block after block of a page."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = ["own_equation.md"]


def blocks(page):
    """Its Python blocks as (number of the line before the first, code)."""
    text = (DOCS / page).read_text()
    for found in re.finditer(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        yield text[: found.start(1)].count("\n"), found.group(1)


@pytest.mark.parametrize("page", PAGES)
def test_code_runs(page):
    names = {"__name__": page}
    found = list(blocks(page))
    assert found
    for line, code in found:
        exec(compile("\n" * line + code, DOCS / page, "exec"), names)
