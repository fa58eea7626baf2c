"""The pages read alike on a code host and on the site, keep to their length, and their figures to the records."""

import posixpath
import re
import unicodedata
from pathlib import Path

import pytest
import yaml

from docs import figures

ROOT = Path(__file__).parents[2]
PAGES = {str(path.relative_to(ROOT)): path.read_text() for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"))}
NAVIGATION = {f"docs/{name}" for name in re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)}
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
GENERATED = re.compile(r"^<!-- docs/\w+\.py writes [^\n]+ -->\n.*?^<!-- end -->$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"^( *)```.*?^\1```$|`[^`\n]*`", re.MULTILINE | re.DOTALL)
OF_RECORDS = "README index which_solver results three_scenes questions reproduction performance why_a_tolerance"
RECORDED = [page for page in PAGES if Path(page).stem in OF_RECORDS.split() and "appendix" not in page]
# What no record of this project holds.
ELSEWHERE = r"\bpaper\b|\bpaper's\b|measured once|published\s+code"


def words(page):
    return len(COMMENT.sub("", PAGES[page]).split())


def test_the_pages_keep_to_their_length():
    assert words("README.md") <= 750
    assert sum(words(page) for page in NAVIGATION) <= 25_000


@pytest.mark.parametrize("page", sorted({"README.md", *NAVIGATION}))
def test_a_page_reads_alike_on_a_code_host(page):
    text = CODE.sub("", PAGES[page])
    assert not re.findall(r"^#.*\{ ?[#.].*\}", text, re.MULTILINE)
    assert "--8<--" not in PAGES[page]
    assert page == "docs/api.md" or not re.findall(r"^:::", text, re.MULTILINE)
    assert not re.findall(r"^(?:!!!|\?\?\?) ", text, re.MULTILINE)
    assert not re.findall(r"\\[(\[]", text)  # formulas are $...$, or a block named math


@pytest.mark.parametrize("page", sorted(PAGES))
def test_no_line_begins_with_a_figure(page):
    """A line that begins with a comment would end its paragraph."""
    assert not re.findall(r"^ *(?:[-*] |\d+\. )?<!--=.*", PAGES[page], re.MULTILINE)


def headings(text):
    return re.findall(r"^#+ (.+)$", CODE.sub(lambda code: code[0] if code[0][0] == "`" else "", text), re.MULTILINE)


def plain(heading):
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").replace("*", "").strip()


def on_a_code_host(heading):
    kept = "".join(
        c for c in plain(heading).lower() if c in "-_ " or unicodedata.category(c)[0] in "LM" or c.isdecimal()
    )
    return kept.replace(" ", "-")


def on_the_site(heading):
    text = unicodedata.normalize("NFKD", plain(heading)).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower())


@pytest.mark.parametrize("page", sorted(PAGES))
def test_the_anchors_of_links_work_on_a_code_host_and_on_the_site(page):
    for target, anchor in re.findall(r"\]\(([^)\s#]*)#([^)\s]+)\)", CODE.sub("", PAGES[page])):
        if "://" in target:
            continue
        to = posixpath.normpath(posixpath.join(posixpath.dirname(page), target)) if target else page
        for rule in (on_a_code_host, on_the_site):
            assert anchor in map(rule, headings(PAGES[to])), f"{target}#{anchor}: {rule.__name__}"


def sentences(text):
    """Of the prose and of tables, without code, headings and what a script writes."""
    text = COMMENT.sub("", CODE.sub("", figures.PLACE.sub("", GENERATED.sub("", text))))
    lines = [line for line in text.splitlines() if not re.match(r" *(#|!\[)", line)]
    for paragraph in re.split(r"\n\s*\n|\n *(?:-|\d\.) ", "\n".join(lines)):
        yield from re.split(r"(?<=[.?])\s+", " ".join(paragraph.split()))


@pytest.mark.parametrize("page", RECORDED)
def test_a_figure_in_the_prose_is_written_from_its_record(page):
    """Seconds and per cents; other numbers, such as sizes and settings, cannot be told apart."""
    found = [
        sentence
        for sentence in sentences(PAGES[page])
        if re.search(r"\d (?:s|ms|µs|%)(?![\w])", sentence) and not re.search(ELSEWHERE, sentence)
    ]
    assert not found, "write them by docs/figures.py"


def test_a_figure_that_is_not_known_is_refused():
    with pytest.raises(ValueError, match="unknown figure 'hours of heat_1d'"):
        figures.figure("hours of heat_1d")
    page = "It takes <!--= seconds of burgers_2d, auto -->1<!--/--> s."
    assert figures.with_figures(page) != page and figures.with_figures(
        figures.with_figures(page)
    ) == figures.with_figures(page)


def test_the_addresses_of_code_and_site_are_set_once():
    site = (ROOT / "mkdocs.yml").read_text()
    settings = [line for line in site.splitlines() if line.startswith(("repo_url", "site_url"))]
    assert len(settings) == 2 and yaml.safe_load(
        site.split("\nhooks")[0].split("\nmarkdown_extensions")[0].replace("!ENV ", "")
    )
