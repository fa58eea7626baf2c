"""docs/architecture.md and CONTRIBUTING.md say what is true of the source."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/architecture.md").read_text()
GUIDE = (ROOT / "CONTRIBUTING.md").read_text()


@pytest.mark.parametrize("home", ["prdp", "prdp_experiments"])
def test_a_folder_includes_only_folders_above_it(home):
    order = re.findall(rf"^\| `csrc/{home}/(\w+)` \|", PAGE, re.MULTILINE)
    folders = {path.name for path in (ROOT / "csrc" / home).iterdir() if path.is_dir()}
    assert set(order) == folders and len(order) == len(folders)
    for path in sorted((ROOT / "csrc" / home).glob("*/*.*")):
        for included in re.findall(rf'#include "{home}/(\w+/\w+\.h)"', path.read_text()):
            above = order.index(included.split("/")[0]) <= order.index(path.parent.name)
            assert above, f"{path.name} includes {included}"


def test_the_library_knows_nothing_of_the_experiments():
    sources = [*(ROOT / "csrc/prdp").rglob("*.*"), *(ROOT / "csrc/bindings").glob("*.*")]
    assert [path.name for path in sources if "prdp_experiments" in path.read_text()] == []
    naming = {path.name for path in (ROOT / "prdp_torch").glob("*.py") if "experiments" in path.read_text()}
    assert naming == {"__init__.py"}  # when they are asked for


def test_the_folders_have_as_many_lines_as_the_page_says():
    rows = re.findall(r"^\| (`.*?`) \| .* \| ([\d,]+) \|$", PAGE, re.MULTILINE)
    assert len(rows) > 10
    for folders, said in rows:
        files = [file for folder in re.findall(r"`(.*?)`", folders) for file in (ROOT / folder).glob("*.*")]
        lines = sum(len(file.read_text().splitlines()) for file in files if file.suffix in (".h", ".cpp", ".py"))
        assert abs(lines - int(said.replace(",", ""))) <= max(100, lines / 10), f"{folders}: {lines}"


def test_the_files_of_the_page_exist():
    named = re.findall(r"`([\w/]+\.(?:h|cpp|py|toml|txt))`", PAGE + GUIDE.split("\n## How to add a method")[1])
    assert len(named) > 30
    homes = [ROOT, ROOT / "csrc/prdp", ROOT / "prdp_torch", ROOT / "prdp_torch/experiments"]
    missing = {
        name
        for name in named
        if "NAME" not in name and not any((home / name).exists() or list(home.glob(f"*/{name}")) for home in homes)
    }
    assert not missing


def named_in(section):
    text = GUIDE.split(f"\n## {section}\n")[1].split("\n## ")[0]
    return {file for row in re.findall(r"^\| (`.*?) \|", text, re.MULTILINE) for file in re.findall(r"`(.*?)`", row)}


@pytest.mark.parametrize("section, word", [("How to add a network", "resnet"), ("How to add a method", "bicgstab")])
def test_whoever_adds_something_is_told_every_file_that_names_the_example(section, word):
    sources = [*(ROOT / "csrc").rglob("*.*"), *(ROOT / "prdp_torch").rglob("*.py"), ROOT / "CMakeLists.txt"]
    naming = {str(path.relative_to(ROOT)) for path in sources if word in path.read_text().lower()}
    assert named_in(section) == naming
