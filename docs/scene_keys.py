"""Write the tables of scene keys in docs/scene_keys.md, from what the reader of scenes declares.

Run it after a change of csrc/prdp_experiments/scenes/scene_keys.cpp and a build: python -m docs.scene_keys
"""

import re
from pathlib import Path

from docs import page_tables
from prdp_torch.experiments import _C

PAGE = Path(__file__).with_name("scene_keys.md")
TABLE = page_tables.places("scene_keys.py")


def table(name):
    """Return the Markdown table of the keys in one table of a scene file; "the top level" has a name too."""
    rows = ["| key | value | meaning |", "|---|---|---|"]
    for key in _C.scene_keys():
        if (key["table"] or "the top level") == name:
            meaning = key["means"].replace("](#", "](command_line.md#")
            meaning += f" ({key['when']})" if key["when"] else ""
            value = re.sub("(>=?) ", r"\1&nbsp;", key["value"].replace("whole number", "integer"))
            value += f" ({key['unit']})" if key["unit"] else ""
            if key["default"]:
                value += "; optional" if key["default"] == "none" else f"; default {key['default']}"
            cells = f"`{key['name']}`", value, meaning
            rows.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    return "\n".join(rows) + "\n"


def with_tables(page):
    """Return the text of the page with its tables written anew."""
    return page_tables.with_tables(page, "scene_keys.py", lambda what: table(what.removeprefix("the keys of ")))


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
