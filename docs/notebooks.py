"""Write the tutorials of docs/ as notebooks into examples/notebooks: python -m docs.notebooks

The text of a page becomes cells of text, its Python blocks cells of code. Links lead to the pages.
"""

import json
import re
from pathlib import Path

DOCS = Path(__file__).parent
NOTEBOOKS = DOCS.parent / "examples" / "notebooks"
TUTORIALS = ("first_emulator", "find_a_field", "correct_a_flow")
CODE = re.compile(r"^```python\n(.*?)\n```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!https?:)([^)\s]+)\)")


def _cell(kind, number, text):
    cell = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": text.strip().splitlines(keepends=True)}
    return cell | ({"execution_count": None, "outputs": []} if kind == "code" else {})


def notebook(name):
    """The notebook of a tutorial as a JSON text, format 4.5, without outputs."""
    page = (DOCS / f"{name}.md").read_text()
    page = re.sub(r" It is also a\s+\[notebook\]\([^)]*\)\.", "", page)
    parts = CODE.split(page)  # text, code, text, ...
    parts[::2] = [LINK.sub(r"](../../docs/\1)", text) for text in parts[::2]]
    cells = [("code" if at % 2 else "markdown", text) for at, text in enumerate(parts) if text.strip()]
    content = {
        "cells": [_cell(kind, at, text) for at, (kind, text) in enumerate(cells)],
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def main():
    for name in TUTORIALS:
        (NOTEBOOKS / f"{name}.ipynb").write_text(notebook(name))


if __name__ == "__main__":
    main()
