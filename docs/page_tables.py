"""Tables that a script writes into a page, between `<!-- docs/SCRIPT writes WHAT -->` and `<!-- end -->`."""

import re


def markdown(head, body):
    """A table of these cells, as text."""
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines).replace("  ", " ") + "\n"


def places(script):
    """The pattern of such a table; group 2 is WHAT."""
    return re.compile(rf"^(<!-- docs/{script} writes ([^\n]+) -->\n).*?^(<!-- end -->)$", re.M | re.S)


def with_tables(page, script, table):
    """Return the text of the page with each table written anew by `table(what)`."""
    return places(script).sub(lambda found: f"{found[1]}\n{table(found[2])}\n{found[3]}", page)
