"""The README, its neighbours and the pages of docs/: every Python block runs, and what the others name exists."""

import inspect
import re
import shlex
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import typer.main
from helpers import as_toml

import prdp_torch as prdp
from docs import notebooks
from prdp_torch.experiments import cli, scenes

ROOT = Path(__file__).parents[2]
PAGES = {str(path.relative_to(ROOT)): path.read_text() for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"))}
BLOCK = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHOWN = [("docs/cpp.md", "examples/cpp/CMakeLists.txt"), ("docs/cpp.md", "examples/cpp/heat_gradient.cpp")]
COMMAND = typer.main.get_command(cli.app)


def blocks(language):
    """(page, first line, code) of every block in this language."""
    return [
        SimpleNamespace(page=page, line=text.count("\n", 0, found.start(2)), code=found[2])
        for page, text in PAGES.items()
        for found in BLOCK.finditer(text)
        if found[1] == language
    ]


def prdp_commands():
    """Every `prdp …` in a shell block, or in the text as inline code, as (page, words)."""
    lines = [(block.page, line) for block in blocks("sh") for line in block.code.splitlines()]
    lines += [(page, code) for page, text in PAGES.items() for code in re.findall(r"`(prdp [a-z][^`\n]*)`", text)]
    return [(page, shlex.split(line, comments=True)) for page, line in lines if line.startswith("prdp ")]


@pytest.fixture
def alone():
    """One thread, for the blocks are small, and the random numbers of the other tests stay what they are."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with torch.random.fork_rng(devices=[]):
        yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("page, file", SHOWN)
def test_a_page_shows_a_file_as_it_is(page, file):
    assert f"\n{(ROOT / file).read_text().rstrip()}\n```" in PAGES[page]


# What a page has its reader run before, cut short.
BEFORE = {"docs/command_line.md": ["train", "heat_1d", "--auto", "--intervals", "3"]}


# The tutorials run as notebooks, which are the same to the letter: test_notebooks.py.
RUN_THERE = {f"docs/{name}.md" for name in notebooks.TUTORIALS}


@pytest.mark.parametrize("page", sorted({block.page for block in blocks("python")} - RUN_THERE))
def test_the_python_blocks_of_a_page_run_in_order(page, tmp_path, monkeypatch, alone):
    monkeypatch.chdir(tmp_path)
    if page in BEFORE:
        COMMAND(BEFORE[page], standalone_mode=False)
    namespace = {"__name__": page}
    for block in blocks("python"):
        if block.page == page:
            code = "\n" * block.line + block.code  # so that a traceback names the line of the page
            exec(compile(code, ROOT / page, "exec"), namespace)


@pytest.mark.parametrize("page, words", prdp_commands(), ids=lambda v: v if isinstance(v, str) else " ".join(v))
def test_the_commands_exist_with_their_options(page, words):
    _, name, *arguments = words
    if not arguments or any(word.isupper() for word in arguments):  # a placeholder such as SCENE or K
        unknown = [word for word in arguments if word.startswith("--") and word not in options(name)]
        assert name in COMMAND.commands and not unknown
        return
    context = COMMAND.commands[name].make_context(name, arguments)
    if (scene := context.params.get("scene")) is not None:
        assert scene in scenes.available() or (ROOT / scene).is_file()


def options(name):
    return {
        option
        for parameter in COMMAND.commands[name].params
        if parameter.param_type_name == "option"
        for option in parameter.opts
    }


@pytest.mark.parametrize("name", COMMAND.commands)
def test_the_page_of_the_command_line_names_every_option(name):
    page = PAGES["docs/command_line.md"]
    section = re.search(rf"^### `prdp {name}\b.*?(?=^##)", page, re.MULTILINE | re.DOTALL)
    assert section, f"docs/command_line.md has no section on `prdp {name}`"
    missing = [option for option in options(name) if f"`{option}" not in section[0]]
    assert not missing


@pytest.mark.parametrize("block", blocks("sh"), ids=lambda block: f"{block.page}:{block.line}")
def test_the_files_and_targets_of_the_shell_blocks_exist(block):
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for line in block.code.splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["make"]:
            assert set(words[1:]) <= set(targets), line
        for word in words:
            if word.startswith(("examples/", "tests/", "benchmarks/")) or word.endswith("requirements.txt"):
                assert (ROOT / word).exists(), line


@pytest.mark.parametrize("block", blocks("toml"), ids=lambda block: f"{block.page}:{block.line}")
def test_the_scenes_are_read(block, tmp_path):
    """A block without a title is a part of a scene: its keys are put into heat_1d. Data from a file replace its own."""
    path = tmp_path / "scene.toml"
    content = tomllib.loads(block.code)
    if "title" not in content:
        whole = tomllib.loads(scenes.available()["heat_1d"].read_text())
        if "file" in content.get("data", {}):
            del whole["data"]
        for name, value in content.items():
            whole[name] = {**whole.get(name, {}), **value} if isinstance(value, dict) else value
        content = whole
    path.write_text(as_toml(content))
    assert scenes.load(path).name == "scene"


def test_the_page_of_the_command_line_names_every_option_of_the_cpp_trainer():
    source = (ROOT / "csrc/prdp_experiments/training/main.cpp").read_text()
    page = PAGES["docs/command_line.md"]
    section = re.search(r"^### `prdp_train.*?(?=^##)", page, re.MULTILINE | re.DOTALL)[0]
    options = re.findall(r'add_(?:option|flag)\("(--[\w-]+)"', source)
    assert len(options) > 5 and all(f"`{option}`" in section for option in options)


@pytest.mark.parametrize("block", blocks("cpp"), ids=lambda block: f"{block.page}:{block.line}")
def test_the_cpp_blocks_use_public_names(block):
    headers = re.findall(r"^ +(csrc/\S+\.h)\)?$", (ROOT / "CMakeLists.txt").read_text(), re.MULTILINE)
    public = "".join((ROOT / header).read_text() for header in headers)
    for header in re.findall(r"#include <(prdp\w*/[^>]+)>", block.code):
        assert f"csrc/{header}" in headers
    for name in re.findall(r"prdp::(\w+)", block.code):
        assert re.search(rf"\b(class|struct|namespace|using) {name}\b|\b{name}\(|TORCH_MODULE\({name}\)", public), name


def test_every_guarantee_names_tests_that_exist():
    page = PAGES["docs/appendix/guarantees.md"].split("## What is guaranteed")[1]
    python = "".join(path.read_text() for path in (ROOT / "tests" / "python").glob("test_*.py"))
    cpp = "".join(path.read_text() for path in (ROOT / "tests" / "cpp").glob("test_*.cpp"))
    tests = set(re.findall(r"^def (test_\w+)\(", python, re.MULTILINE))
    tests |= {".".join(names) for names in re.findall(r"^TEST\((\w+), (\w+)\)", cpp, re.MULTILINE)}
    named = re.findall(r"`(test_\w+|[A-Z]\w+\.[A-Z]\w+)`", page)
    assert [name for name in named if name not in tests] == []
    guarantees = re.findall(r"^\| (\d+) \| .* \| (.*) \|$", page, re.MULTILINE)
    assert [int(number) for number, _ in guarantees] == list(range(1, len(guarantees) + 1)) and len(guarantees) > 30
    assert [number for number, cell in guarantees if not re.fullmatch(r"`[\w.]+`(, `[\w.]+`)*", cell)] == []


@pytest.mark.parametrize("page", PAGES)
def test_the_links_to_files_lead_somewhere(page):
    """mkdocs checks the pages of the site; this also covers the README."""
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[\w-]*)?\)", BLOCK.sub("", PAGES[page])):
        if "://" not in target:
            assert (ROOT / page).parent.joinpath(target).exists(), target


def test_the_page_of_devices_says_on_which_commit_kernels_last_ran_on_which_card():
    page = " ".join((ROOT / "docs/devices.md").read_text().split())
    kernels, others = re.search(r"\| last run on a card \| \| (.*?) \| (.*?) \|", page).groups()
    a_run = r"commit [0-9a-f]{7}, [A-Z]+\d+"
    assert re.fullmatch(a_run, others) and (kernels == "none" or re.fullmatch(a_run, kernels))
    never = "it has kernels, which have not run on a GPU yet"
    assert (never in page) == (kernels == "none"), page[:400]


def test_every_page_is_in_the_navigation():
    named = set(re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    pages = {Path(page) for page in PAGES if page.startswith("docs/")}
    assert named == {page.name for page in pages if page.parent.name != "appendix"}


def documented():
    """What docs/api.md renders: {path: the names that it is limited to, or None}."""
    entries = re.split(r"^::: ", PAGES["docs/api.md"], flags=re.MULTILINE)[1:]
    limits = (re.search(r"^ +members: \[(.*)\]$", entry, re.MULTILINE) for entry in entries)
    return {
        entry.split()[0]: limit and set(re.split(", *", limit[1])) for entry, limit in zip(entries, limits, strict=True)
    }


def public_names():
    """(module, name) of all that `import prdp_torch` offers: its own names and those of its modules."""
    inside = [getattr(prdp.experiments, name) for name in prdp.experiments.__all__]
    for name, value in [*((name, getattr(prdp, name)) for name in prdp.__all__), *((m.__name__, m) for m in inside)]:
        if not inspect.ismodule(value):
            yield "prdp_torch", name
            continue
        for inner, content in vars(value).items():
            if not inner.startswith("_") and getattr(content, "__module__", None) == value.__name__:
                yield value.__name__, inner


@pytest.mark.parametrize("module, name", list(public_names()))
def test_the_reference_has_every_public_name(module, name):
    rendered = documented()
    home = getattr(getattr(sys.modules[module], name), "__module__", module)
    whole = [path for path in (module, home) if path in rendered and (rendered[path] is None or name in rendered[path])]
    assert whole or f"{module}.{name}" in rendered
    assert inspect.getdoc(getattr(sys.modules[module], name))


@pytest.mark.parametrize("path", sorted((ROOT / "prdp_torch").rglob("*.py")), ids=lambda path: path.stem)
def test_the_examples_of_docstrings_are_shown_as_code(path):
    """mkdocstrings shows only what stands under "Examples:" as code, and takes other lines with >>> for quotations."""
    assert not re.search(r"\n\n +>>> |^ +Example:$", path.read_text(), re.MULTILINE)
