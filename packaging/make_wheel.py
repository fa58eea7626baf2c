"""Make the wheel of this Python and its torch: `python packaging/make_wheel.py FOLDER`.

It runs on the CPU and on CUDA alike: it links no library of CUDA, and those of torch stay outside, so that it takes the
ones of the torch that it is installed beside. Its version names that torch, as in X+torch2.13.0.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from prdp_backend import find_torch

ROOT = Path(__file__).resolve().parents[1]
# They are found beside the package when it is loaded.
TORCH = ("libtorch.so", "libtorch_cpu.so", "libtorch_python.so", "libc10.so")


def build(folder):
    """The wheel, in this folder; it runs on systems like this one."""
    found = find_torch()
    if found is None:
        sys.exit("prdp_torch: there is no torch to make a wheel for; pip install torch")
    tag = f"+torch{found[1].partition('+')[0]}"
    named = ["egg_info", "--egg-base", folder, "--tag-build", tag]
    made = ["build", "--build-base", Path(folder, "base"), "bdist_wheel", "--dist-dir", folder]
    subprocess.run([sys.executable, "setup.py", "-q", *named, *made], cwd=ROOT, check=True)
    (wheel,) = Path(folder).glob("*.whl")
    return wheel


def main(folder):
    with tempfile.TemporaryDirectory() as made:
        # It then says from which version of the C library on it runs.
        options = [part for name in TORCH for part in ("--exclude", name)]
        command = [sys.executable, "-m", "auditwheel", "repair", build(made), "--wheel-dir", folder, *options]
        subprocess.run(list(map(str, command)), check=True)


if __name__ == "__main__":
    main(sys.argv[1])
