"""Builds the Python package. CMake knows how; this file only calls it."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
sys.path.append(str(ROOT / "packaging"))
from prdp_backend import find_torch, requirement  # noqa: E402

BUILD = Path(os.environ.get("PRDP_BUILD_DIR", ROOT / "build"))


def configuration(torch):
    """The arguments of CMake. It starts afresh where it had another torch, or where its tools have gone since, as those
    of isolated builds do."""
    arguments = ["-S", ROOT, "-B", BUILD, f"-DPython_EXECUTABLE={sys.executable}", f"-DTorch_DIR={torch}"]
    arguments += shlex.split(os.environ.get("CMAKE_ARGS", ""))
    cache = BUILD / "CMakeCache.txt"
    known = dict(re.findall(r"^(\w+):\w+=(.*)$", cache.read_text(), re.MULTILINE)) if cache.exists() else {}
    if known.get("Torch_DIR") == str(torch) and Path(known["CMAKE_COMMAND"]).exists():
        return arguments
    return ["--fresh", *arguments, *(["-G", "Ninja"] if shutil.which("ninja") else [])]


class CMakeBuild(build_ext):
    def build_extension(self, ext):
        package = Path(self.get_ext_fullpath(ext.name)).resolve().parent
        torch = find_torch()[0] / "share" / "cmake" / "Torch"
        subprocess.run(["cmake", *configuration(torch)], check=True)
        subprocess.run(["cmake", "--build", BUILD, "--parallel", str(os.cpu_count()), "--target", "python"], check=True)
        subprocess.run(["cmake", "--install", BUILD, "--component", "python", "--prefix", package], check=True)
        if not self.editable_mode:  # an editable install finds them in examples/
            shutil.copytree(ROOT / "examples" / "scenes", package / "scenes", dirs_exist_ok=True)


setup(
    version=re.search(r"project\(prdp VERSION ([\d.]+)", (ROOT / "CMakeLists.txt").read_text())[1],
    install_requires=[requirement()],
    ext_modules=[Extension("prdp_torch._C", sources=[])],
    cmdclass={"build_ext": CMakeBuild},
)
