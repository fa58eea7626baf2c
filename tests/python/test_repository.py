"""What is published beside the code: versions, sizes, the checks of others."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import torch
import yaml
from PIL import Image

import prdp_torch as prdp

ROOT = Path(__file__).parents[2]
VERSION = re.search(r"project\(prdp VERSION ([\d.]+)", (ROOT / "CMakeLists.txt").read_text())[1]


def tracked(*patterns):
    listed = subprocess.run(["git", "ls-files", "-z", *patterns], cwd=ROOT, capture_output=True, text=True, check=True)
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()]


def output(*command):
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_version_is_shown_everywhere():
    assert prdp.__version__ == VERSION
    shown = output(sys.executable, "-m", "prdp_torch", "--version")
    assert shown == f"prdp_torch {VERSION}, torch {torch.__version__}\n"
    release = torch.__version__.partition("+")[0]
    assert output(ROOT / "build/prdp_train", "--version") == f"prdp_torch {VERSION}, torch {release}\n"


def test_the_help_of_the_command_is_what_it_was():
    assert "Train through PDE solves that stop early, and see what it saves." in output(
        sys.executable, "-m", "prdp_torch", "--help"
    )


def test_the_version_is_written_once():
    sources = tracked("*.py", "*.toml", "*.cff", "*.cmake", "*.txt", "*.h", "*.cpp", "*.yml", "*.yaml")
    written = re.compile(rf"(?<![\d.]){re.escape(VERSION)}(?![\d.])")
    assert {path.name for path in sources if written.search(path.read_text())} == {"CMakeLists.txt"}


def test_no_tracked_file_is_large():
    """Clones stay quick. The trajectories of heat_2d in the paper's code are from before this limit."""
    large = {str(path.relative_to(ROOT)) for path in tracked() if path.stat().st_size > 300_000}
    assert large <= {"tests/data/heat2d.npz"}


def test_a_source_file_fits_in_a_head():
    lines = {path: len(path.read_text().splitlines()) for path in tracked("*.h", "*.cpp", "*.py")}
    assert len(lines) > 700
    assert not {str(path.relative_to(ROOT)): n for path, n in lines.items() if n > 350}


def test_pictures_have_no_alpha_channel():
    """It is a quarter of their pixels and says nothing."""
    pictures = tracked("*.png")
    assert len(pictures) > 30
    for path in pictures:
        with Image.open(path) as picture:
            assert "A" not in picture.mode, path


def test_a_chart_is_written_small_and_looks_the_same(tmp_path):
    from prdp_torch.experiments.charts import make_figure, write_png

    figure, (axes,) = make_figure()
    axes.plot([1, 3, 2])
    write_png(figure, tmp_path / "small.png", dpi=110)
    figure.savefig(tmp_path / "plain.png", dpi=110)
    with Image.open(tmp_path / "small.png") as small, Image.open(tmp_path / "plain.png") as plain:
        assert small.convert("RGBA").tobytes() == plain.convert("RGBA").tobytes()
        assert small.info["dpi"] == pytest.approx(plain.info["dpi"], abs=0.01)
    assert (tmp_path / "small.png").stat().st_size < (tmp_path / "plain.png").stat().st_size


def test_pre_commit_runs_the_linters_of_make_test():
    (hooks,) = (repo["hooks"] for repo in yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"])
    recipe = (ROOT / "Makefile").read_text().split("\ntest:")[1].split("\n\n")[0]
    assert {hook["language"] for hook in hooks} == {"system"}  # nothing is downloaded twice
    for hook in hooks:
        program, *options = hook["entry"].removeprefix(".venv/bin/").split()
        assert f"$(BIN)/{program}" in recipe
        assert set(options) - {"--force-exclude"} <= set(recipe.split())
        files = {"ruff": "examples/quickstart.py", "clang-format": "csrc/prdp/error_text.cpp"}
        output(ROOT / ".venv/bin" / program, *options, ROOT / files[program])


def test_the_workflow_runs_the_commands_of_the_readme_and_compiles_the_kernels():
    (job,) = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    shown = re.search(r"## Two commands\n\n```sh\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    assert commands == [*(line.split("  ")[0] for line in shown.splitlines()), "make kernels"]
    oldest = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    assert oldest == f">={job['strategy']['matrix']['python'][0]}"


def test_the_wheels_are_for_every_supported_python_and_torch():
    jobs = yaml.safe_load((ROOT / ".github/workflows/wheels.yml").read_text())["jobs"]
    ci = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]["linux"]["strategy"]["matrix"]
    matrix, steps = jobs["wheel"]["strategy"]["matrix"], jobs["wheel"]["steps"]
    assert [matrix["python"][0], matrix["python"][-1]] == ci["python"]
    oldest = re.search(r"VERSION_LESS ([\d.]+)\)", (ROOT / "cmake/prdpTorch.cmake").read_text())[1]
    tested = re.search(r"^torch==(.*)$", (ROOT / "requirements.txt").read_text(), re.MULTILINE)[1]
    assert matrix["torch"][0] == f"{oldest}.0" and tested in matrix["torch"]
    (made,) = (step["run"] for step in steps if step.get("name") == "wheel")
    assert "python packaging/make_wheel.py dist" in made and jobs["release"]["needs"] == "wheel"
    assert "$(BIN)/python packaging/make_wheel.py dist" in (ROOT / "Makefile").read_text()


def test_the_citation_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    paper = citation["preferred-citation"]
    assert citation["cff-version"] == "1.2.0" and citation["title"] == "prdp_torch"
    assert paper["title"] == "PRDP: Progressively Refined Differentiable Physics" and paper["year"] == 2025
    assert [author["family-names"] for author in paper["authors"]] == ["Bhatia", "Koehler", "Thuerey"]


def test_the_site_can_be_searched_when_it_is_opened_as_files():
    """By the plugin of its theme, whose script for that would come from another site."""
    site = (ROOT / "mkdocs.yml").read_text()
    assert re.search(r"^plugins:\n  - search\n  - offline\b", site, re.MULTILINE)
    (script,) = re.search(r"^  polyfills: \[(.*?)\]", site, re.MULTILINE)[1].split(",")
    assert "iframe-worker" in script and (ROOT / "docs" / script).is_file()
