"""The tutorials of docs/gallery.md run, draw their pictures, and show what the page says."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
NUMBER = re.compile(r"\d+\.\d+|\d[\d,]*")


@pytest.fixture
def printed(tmp_path):
    """Run a tutorial: the numbers that it prints, without the K of its titles."""

    def run(name, *arguments):
        script = ROOT / "examples" / f"{name}.py"
        assert len(script.read_text().splitlines()) <= 60
        command = [sys.executable, script, *map(str, arguments)]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert picture.size[0] > 500 and "A" not in picture.mode
        return [float(word.replace(",", "")) for word in NUMBER.findall(re.sub(r"K = \d+:", "", done.stdout))]

    return run


def test_the_emulator_needs_fewer_than_all_iterations(printed):
    accurate, _, all_of_them, auto, _, iterations = printed("first_emulator", 24, 20)
    assert iterations < all_of_them / 1.5
    assert auto < 1.1 * accurate < 0.3


def test_the_corrector_is_better_than_the_coarse_solver_alone(printed):
    _, corrected, coarse, *_ = printed("coarse_corrector", 32, 60)
    assert corrected < 0.8 * coarse


def test_the_permeability_is_found_and_the_solves_become_short(printed):
    misfit, error, first, last = printed("inverse_permeability", 24, 100)
    assert misfit < 0.02 and error < 0.3
    assert last < first


def test_an_emulator_learns_from_a_file(printed):
    pytest.importorskip("h5py")
    _, error, _ = printed("pdebench_data", 40)
    assert error < 0.3


def test_the_page_shows_every_tutorial_with_its_picture():
    page = (ROOT / "docs" / "gallery.md").read_text()
    shown = re.findall(r"!\[[^\]]+\]\(gallery/(\w+)\.png\)", page)
    assert sorted(shown) == sorted(path.stem for path in (ROOT / "docs" / "gallery").glob("*.png"))
    for name in shown:
        assert f"python examples/{name}.py" in page
        assert (ROOT / "docs" / "gallery" / f"{name}.png").stat().st_size < 80_000
