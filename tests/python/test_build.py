"""What a build takes: the torch of its environment, and only the headers that are there."""

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
CMAKE = Path(sys.executable).with_name("cmake")
sys.path.append(str(ROOT / "packaging"))
import prdp_backend  # noqa: E402

PINNED = re.search(r"^torch==.*$", (ROOT / "requirements.txt").read_text(), re.MULTILINE)[0]


@pytest.fixture
def environment(tmp_path, monkeypatch):
    """The packages of an environment of its own, which an isolated build cannot import."""
    monkeypatch.setattr(sys, "path", [])
    monkeypatch.setattr(prdp_backend.sysconfig, "get_path", lambda kind: str(tmp_path))
    monkeypatch.setattr(prdp_backend.site, "getsitepackages", lambda: [])
    monkeypatch.setattr(prdp_backend.site, "getusersitepackages", lambda: str(tmp_path / "user"))
    return tmp_path


def fake_torch(folder, version):
    """What a build reads first of a torch."""
    cmake = folder / "torch" / "share" / "cmake" / "Torch"
    cmake.mkdir(parents=True)
    (folder / "torch" / "__init__.py").touch()
    (folder / "torch" / "version.py").write_text(
        f"from typing import Optional\n__version__ = '{version}'\ncuda = None\n"
    )
    (cmake / "TorchConfig.cmake").touch()
    (cmake / "TorchConfigVersion.cmake").write_text(f'set(PACKAGE_VERSION "{version.partition("+")[0]}")\n')
    return cmake


def test_an_isolated_build_takes_the_torch_behind_it(environment):
    fake_torch(environment, "2.98.1+cu130")
    assert prdp_backend.find_torch() == (environment / "torch", "2.98.1+cu130")
    assert prdp_backend.requirement() == "torch==2.98.1"  # for the CPU as for CUDA
    assert prdp_backend.get_requires_for_build_wheel() == prdp_backend.get_requires_for_build_editable() == []


def test_a_build_without_torch_asks_for_the_tested_one(environment):
    assert prdp_backend.find_torch() is None and prdp_backend.requirement() == "torch"
    assert prdp_backend.get_requires_for_build_wheel() == [PINNED]


@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_without_isolation_and_without_torch_one_sentence_says_what_to_type(environment, kind):
    with pytest.raises(SystemExit, match=f"has no torch to build against; leave out .*, or first pip install {PINNED}"):
        getattr(prdp_backend, f"prepare_metadata_for_build_{kind}")(str(environment))


def test_the_installed_package_requires_the_torch_that_it_was_built_against():
    required = importlib.metadata.requires("prdp_torch")
    assert f"torch=={torch.__version__.partition('+')[0]}" in required


def test_type_checkers_find_an_editable_installation():
    """They follow a path, and not the import hook that setuptools writes by default."""
    files = importlib.metadata.files("prdp_torch")
    (path,) = (file for file in files if file.suffix == ".pth")
    assert path.read_text().strip() == str(ROOT)


def configure(folder, *options, **run):
    tools = (f"-DCMAKE_MAKE_PROGRAM={CMAKE.with_name('ninja')}", f"-DPython_EXECUTABLE={sys.executable}")
    command = (CMAKE, "-S", ROOT, "-B", folder, "-G", "Ninja", *tools, *options)
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    return done.returncode, " ".join((done.stdout + done.stderr).split())


NO_SYSTEM_HEADERS = "-DCMAKE_FIND_USE_CMAKE_SYSTEM_PATH=OFF"


def test_only_the_library_is_built_where_no_header_of_the_system_is_found(tmp_path):
    status, said = configure(tmp_path, NO_SYSTEM_HEADERS)
    assert status == 0, said
    assert "without PRDP_EXPERIMENTS, as <toml++/toml.h> was not found; apt-get install libtomlplusplus-dev" in said
    rules = (tmp_path / "build.ninja").read_text()
    targets = "\n".join(re.findall(r"^build (\S+)", rules, re.MULTILINE))
    assert "libprdp.so" in targets and "CMakeFiles/_C.dir" in targets
    assert not re.search(r"experiments|prdp_train|prdp_tests", targets)
    assert "libprdp_fibers.so" in targets  # which `make cuda` asks for, without GoogleTest
    assert not re.search(r"^build all: .*prdp_fibers", rules, re.MULTILINE)


def test_a_part_that_was_asked_for_is_not_left_out(tmp_path):
    status, said = configure(tmp_path, NO_SYSTEM_HEADERS, "-DPRDP_EXPERIMENTS=ON")
    assert status != 0
    assert "<toml++/toml.h> was not found; apt-get install libtomlplusplus-dev, or configure with -DPRDP_EXP" in said


def test_headers_may_lie_in_a_folder_that_is_named(tmp_path):
    """As in `make cuda HEADERS=`: headers alone, without files for CMake."""
    (eigen,) = Path(sys.prefix).glob("lib/python*/site-packages/cmeel.prefix/include/eigen3/Eigen")
    folder = tmp_path / "headers"
    folder.mkdir()
    for header in (eigen, Path("/usr/include/toml++"), Path("/usr/include/nlohmann")):
        (folder / header.name).symlink_to(header)
    options = (NO_SYSTEM_HEADERS, "-DCMAKE_DISABLE_FIND_PACKAGE_Eigen3=ON", "-DPRDP_EXPERIMENTS=ON")
    status, said = configure(tmp_path / "build", *options, f"-DCMAKE_INCLUDE_PATH={folder}")
    assert status == 0, said
    found = (tmp_path / "build" / "CMakeCache.txt").read_text()
    for name in ("tomlplusplus", "json"):
        assert f"{name}_INCLUDE_DIR:PATH={folder}\n" in found
    assert re.search(r"^eigen_INCLUDE_DIR:PATH=/", found, re.MULTILINE)  # there, or beside torch


FINDS = 'read -r line; for header in {}; do [ "$line" = "#include <$header>" ] && exit; done; exit 1'


def system_packages(folder, compiler, *wanted, refuses=False, **environment):
    """What cmake/system-packages.sh does with this compiler: its status, messages and calls of apt-get."""
    folder.mkdir()
    calls = folder / "calls"
    calls.touch()
    commands = {"c++": compiler, "id": "echo 0", "apt-get": f'echo "$@" >> {calls}; exit {int(refuses)}'}
    for name, body in commands.items():
        command = folder / name
        command.write_text(f"#!/bin/sh\n{body}\n")
        command.chmod(0o755)
    script = [ROOT / "cmake" / "system-packages.sh", *wanted]
    alone = {"PATH": f"{folder}:/usr/bin:/bin", **environment}
    done = subprocess.run(script, env=alone, capture_output=True, text=True)
    return done.returncode, done.stderr, calls.read_text()


def test_headers_that_the_compiler_does_not_find_are_installed(tmp_path):
    all_but_one = "gtest/gtest.h toml++/toml.h nlohmann/json.hpp"
    assert system_packages(tmp_path / "all", FINDS.format(f"{all_but_one} CLI/CLI.hpp")) == (0, "", "")
    status, said, calls = system_packages(tmp_path / "none", FINDS.format("vector"))
    assert (status, said) == (0, "")
    packages = "libgtest-dev libtomlplusplus-dev nlohmann-json3-dev libcli11-dev"
    assert calls.splitlines() == ["update -qq", f"install -y --no-install-recommends -qq {packages}"]
    assert system_packages(tmp_path / "one", FINDS.format(all_but_one))[2].endswith("-qq libcli11-dev\n")
    named = system_packages(tmp_path / "named", FINDS.format("toml++/toml.h"), "toml++/toml.h", "nlohmann/json.hpp")
    assert named[2].endswith("-qq nlohmann-json3-dev\n")


def test_headers_that_cannot_be_installed_are_named_in_one_sentence(tmp_path):
    status, said, _ = system_packages(tmp_path / "offline", FINDS.format("gtest/gtest.h CLI/CLI.hpp"), refuses=True)
    assert status == 1 and said.count("\n") == 1
    assert "cannot be installed from here: libtomlplusplus-dev nlohmann-json3-dev; install them" in said
    status, said, calls = system_packages(tmp_path / "no_compiler", "", CXX="nobodys-c++")
    assert (status, calls) == (1, "") and "there is no C++ compiler nobodys-c++" in said


def test_headers_in_a_folder_that_is_named_are_not_installed(tmp_path):
    """As in `make cuda HEADERS=`, by a compiler that looks nowhere else."""
    header = tmp_path / "headers" / "gtest" / "gtest.h"
    header.parent.mkdir(parents=True)
    header.touch()
    compiler = 'exec /usr/bin/c++ -nostdinc "$@"'
    there = system_packages(tmp_path / "there", compiler, "gtest/gtest.h", HEADERS=str(tmp_path / "headers"))
    assert there == (0, "", "")
    assert system_packages(tmp_path / "not_there", compiler, "gtest/gtest.h")[2].endswith("libgtest-dev\n")


def cuda_packages(folder, python):
    """What `make cuda` installs into an environment beside this Python's packages, without a network."""
    command = [ROOT / "cmake" / "cuda-packages.sh", python, folder]
    alone = {"PATH": "/usr/bin:/bin", "PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": "/dev/null"}
    return subprocess.run(list(map(str, command)), cwd=ROOT, env=alone, capture_output=True, text=True)


def test_make_cuda_takes_the_packages_that_are_there(tmp_path):
    done = cuda_packages(tmp_path / "all", sys.executable)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
    seen = "import torch, pytest; print(pytest.__file__)"
    found = subprocess.run([tmp_path / "all" / "bin" / "python", "-c", seen], capture_output=True, text=True)
    assert found.stdout.strip() == pytest.__file__
    done = cuda_packages(tmp_path / "few", sys._base_executable)
    assert done.returncode == 1 and "cmeel-eigen==" in done.stderr
    assert "prdp: these packages are missing and cannot be installed from here: " in done.stderr


def test_make_cuda_runs_each_tool_of_a_sanitizer_where_there_is_one(tmp_path):
    tool = tmp_path / "compute-sanitizer"
    tool.write_text('#!/bin/sh\necho "$PYTORCH_NO_CUDA_MEMORY_CACHING $*"; [ "$2" != "$FAILS" ]\n')
    make = ["make", "--no-print-directory", "-s", "sanitize-cuda"]

    def run(**environment):
        alone = {"PATH": "/usr/bin:/bin", **environment}
        return subprocess.run(make, cwd=ROOT, env=alone, capture_output=True, text=True)

    with_tool = f"{tmp_path}:/usr/bin:/bin"
    assert "no compute-sanitizer here" in run().stdout
    tool.chmod(0o755)
    done = run(PATH=with_tool)
    told = [line.split(" .venv-cuda/bin/python -m pytest -q -m cuda ")[0] for line in done.stdout.splitlines()]
    tools = ("memcheck", "racecheck", "synccheck")
    assert done.returncode == 0 and told == [f"1 --tool {name} --error-exitcode 1" for name in tools]
    done = run(PATH=with_tool, FAILS="racecheck")
    assert done.returncode != 0 and len(done.stdout.splitlines()) == 2
    assert "sanitize-cuda" in (ROOT / "Makefile").read_text().partition("\ncuda:\n")[2].partition("\n\n")[0]


def test_a_torch_that_is_too_old_is_refused_in_one_sentence(tmp_path):
    status, said = configure(tmp_path / "build", f"-DTorch_DIR={fake_torch(tmp_path, '2.10.1+cu130')}")
    assert status != 0 and "prdp: needs PyTorch 2.11 or newer, found 2.10.1 in " in said


def test_a_folder_without_torch_is_named(tmp_path):
    status, said = configure(tmp_path / "build", f"-DTorch_DIR={tmp_path / 'moved'}")
    assert status != 0 and f"prdp: Torch_DIR is {tmp_path / 'moved'}, where there is no LibTorch; leave it out" in said


def test_warnings_stop_no_user():
    """A newer compiler than ours may warn of something new. The Makefile makes them errors."""
    assert 'option(PRDP_WERROR "Treat warnings as errors" OFF)' in (ROOT / "CMakeLists.txt").read_text()
    assert "-DPRDP_WERROR=ON" in (ROOT / "Makefile").read_text()
