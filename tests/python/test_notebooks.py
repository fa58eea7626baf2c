"""The tutorials: their notebooks are those of the pages, run, and show what the pages say."""

import json
import re

import pytest
import torch

from docs import notebooks

NUMBER = re.compile(r"\d+\.\d+")


@pytest.fixture
def printed(capsys):
    """Run the cells of a notebook in order: its names, and what it printed."""

    def run(name):
        content = json.loads((notebooks.NOTEBOOKS / f"{name}.ipynb").read_text())
        names = {"__name__": "__main__"}
        threads = torch.get_num_threads()
        with torch.random.fork_rng(devices=[]):
            for number, cell in enumerate(content["cells"]):
                if cell["cell_type"] == "code":
                    exec(compile("".join(cell["source"]), f"{name}.ipynb, cell {number}", "exec"), names)
        torch.set_num_threads(threads)
        return names, capsys.readouterr().out.splitlines()

    return run


@pytest.mark.parametrize("name", notebooks.TUTORIALS)
def test_a_notebook_is_that_of_its_page(name):
    assert (notebooks.NOTEBOOKS / f"{name}.ipynb").read_text() == notebooks.notebook(name), "python -m docs.notebooks"


@pytest.mark.parametrize("name", notebooks.TUTORIALS)
def test_every_link_of_a_notebook_leads_to_a_file(name):
    content = json.loads((notebooks.NOTEBOOKS / f"{name}.ipynb").read_text())
    text = "".join(line for cell in content["cells"] if cell["cell_type"] == "markdown" for line in cell["source"])
    links = [target for target in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in target]
    assert links and not [target for target in links if not (notebooks.NOTEBOOKS / target).is_file()]


def test_auto_trains_the_emulator_in_less_time_to_the_same_error(printed):
    names, lines = printed("first_emulator")
    accurate, auto, multigrid, _ = (
        [float(number) for number in NUMBER.findall(line)] for line in lines if "error" in line
    )
    assert max(auto[0], multigrid[0]) < 1.1 * accurate[0] < 0.2
    assert auto[1] < 0.8 * accurate[1]
    assert not names["controller"].warning


def test_the_field_is_found_with_either_accuracy_and_sooner_with_auto(printed):
    _, lines = printed("find_a_field")
    diagonal, multigrid, auto = ([float(number) for number in NUMBER.findall(line)] for line in lines)
    assert max(diagonal[0], multigrid[0], auto[0]) < 0.13
    assert auto[2] < 0.7 * diagonal[2]


def test_the_corrector_beats_the_coarse_flow_and_does_not_need_the_gradient(printed):
    _, lines = printed("correct_a_flow")
    coarse, one, four, exact = ([float(number) for number in NUMBER.findall(line)] for line in lines)
    assert max(one[0], four[0], exact[0]) < 0.5 * coarse[0]
    assert max(one[1], four[1], exact[1]) < 0.5 * coarse[1]
    assert four[1] < 1.2 * exact[1]
