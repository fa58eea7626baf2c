"""The types of the compiled modules, for editors: their stubs are generated."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("module", ["prdp_torch._C", "prdp_torch.experiments._C"])
def test_the_stub_is_that_of_the_compiled_module(tmp_path, module):
    command = [sys.executable, "-m", "pybind11_stubgen", module, "-o"]
    subprocess.run([*command, tmp_path], cwd=ROOT, capture_output=True, check=True)
    stub = f"{module.replace('.', '/')}.pyi"
    generated = (tmp_path / stub).read_text()
    assert (ROOT / stub).read_text() == generated, f"generate it anew: python {' '.join(command[1:])} ."
