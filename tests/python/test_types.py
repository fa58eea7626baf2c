"""Types, for editors and type checkers: the stubs of the compiled modules are generated, all else is annotated."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import prdp_torch as prdp
from prdp_torch import _C, controller

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("module", ["prdp_torch._C", "prdp_torch.experiments._C"])
def test_the_stub_is_that_of_the_compiled_module(tmp_path, module):
    command = [sys.executable, "-m", "pybind11_stubgen", module, "-o"]
    subprocess.run([*command, tmp_path], cwd=ROOT, capture_output=True, check=True)
    stub = f"{module.replace('.', '/')}.pyi"
    generated = (tmp_path / stub).read_text()
    assert (ROOT / stub).read_text() == generated, f"generate it anew: python {' '.join(command[1:])} ."


def test_the_statuses_are_those_of_the_compiled_library():
    assert {status.name: status.value for status in prdp.SolveStatus} == _C.SOLVE_STATUSES


@pytest.mark.parametrize("of", ["PRDP", "Tolerance"])
def test_the_settings_of_controllers_are_those_of_the_compiled_library(of):
    settings = getattr(controller, f"{of}Settings").__annotations__
    assert list(settings) == list(getattr(_C, f"{of.upper()}_DEFAULTS"))


WRONG = {
    "prdp.Heet": 'Module has no attribute "Heet"',
    'prdp.Heat((30,), 1e-3, 1.0, prdp.CG(5), backward="implict")': "Literal['implicit', 'unrolled', 'none']",
    'prdp.Heat((30,), 1e-3, 1.0, prdp.CG(5), onfailure="warn")': 'did you mean "on_failure"?',
    "prdp.PRDPController([heat], tau_stopp=0.9)": 'did you mean "tau_stop"',
    "prdp.PRDPController([torch.nn.ReLU()])": 'expected "Refinable"',
    "prdp.CG(5, restart=3)": 'Unexpected keyword argument "restart"',
    "heat(u).iterations": '"Tensor" has no attribute "iterations"',
}


def test_mypy_finds_what_is_wrong_in_a_script_of_a_user(tmp_path):
    start = ["import torch", "import prdp_torch as prdp", "heat = prdp.Heat((30,), 1e-3, 1.0, prdp.Jacobi(5))"]
    start.append("u = torch.ones(1, 1, 30)")
    script = tmp_path / "script.py"
    script.write_text("\n".join([*start, *WRONG, ""]))
    command = [sys.executable, "-m", "mypy", "--config-file", ROOT / "pyproject.toml", "--no-pretty", script]
    found = subprocess.run(list(map(str, command)), cwd=ROOT, capture_output=True, text=True).stdout
    errors = dict(re.findall(r"script.py:(\d+): error: (.*)", found))
    assert {int(line) for line in errors} == {len(start) + 1 + i for i in range(len(WRONG))}, found
    for i, words in enumerate(WRONG.values()):
        assert words in errors[str(len(start) + 1 + i)]
