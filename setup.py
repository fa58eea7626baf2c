"""Builds the Python package. CMake knows how; this file only calls it."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
BUILD = Path(os.environ.get("PRDP_BUILD_DIR", ROOT / "build"))


class CMakeBuild(build_ext):
    def build_extension(self, ext):
        package = Path(self.get_ext_fullpath(ext.name)).resolve().parent
        configure = ["cmake", "-S", ROOT, "-B", BUILD, f"-DPython_EXECUTABLE={sys.executable}"]
        if shutil.which("ninja") and not (BUILD / "CMakeCache.txt").exists():
            configure += ["-G", "Ninja"]
        subprocess.run(configure, check=True)
        subprocess.run(["cmake", "--build", BUILD, "--parallel", str(os.cpu_count()), "--target", "python"], check=True)
        subprocess.run(["cmake", "--install", BUILD, "--component", "python", "--prefix", package], check=True)
        if not self.editable_mode:  # an editable install finds them in examples/
            shutil.copytree(ROOT / "examples" / "scenes", package / "scenes", dirs_exist_ok=True)


setup(
    version=re.search(r"project\(prdp VERSION ([\d.]+)", (ROOT / "CMakeLists.txt").read_text())[1],
    ext_modules=[Extension("prdp_torch._C", sources=[])],
    cmdclass={"build_ext": CMakeBuild},
)
