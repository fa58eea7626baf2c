"""The types of the compiled library, for editors: prdp_torch/_C.pyi is generated from it."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_stub_is_that_of_the_compiled_library(tmp_path):
    command = [sys.executable, "-m", "pybind11_stubgen", "prdp_torch._C", "-o"]
    subprocess.run([*command, tmp_path], cwd=ROOT, capture_output=True, check=True)
    generated = (tmp_path / "prdp_torch/_C.pyi").read_text()
    assert (ROOT / "prdp_torch/_C.pyi").read_text() == generated, f"generate it anew: python {' '.join(command[1:])} ."
