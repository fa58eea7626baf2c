"""What mkdocs does to a page beside Markdown: links to files of the repository, and formulas.

A page links to a file outside docs as `../examples/quickstart.py`, which a code host resolves. The site has no such
file: it links to the repository, if `repo_url` is set, and else shows the words alone. Formulas become MathML, which a
browser shows without a script."""

import html
import posixpath
import re

from latex2mathml.converter import convert

LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(((?:\.\./)+[^)\s]+)\)")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_markdown(markdown, page, config, **_):
    home = posixpath.dirname(posixpath.join("docs", page.file.src_uri))

    def link(found):
        target = posixpath.normpath(posixpath.join(home, found[2]))
        if target.startswith("docs/"):
            return found[0]
        return f"[{found[1]}]({config.repo_url.rstrip('/')}/blob/HEAD/{target})" if config.repo_url else found[1]

    return LINK.sub(link, markdown)


def on_page_content(content, **_):
    def formula(found):
        display = "inline" if found[2] == "(" else "block"
        return convert(html.unescape(found[3].strip()), display=display)

    return FORMULA.sub(formula, content)
