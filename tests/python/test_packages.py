"""What users install: the C++ package, the source archive and the wheel, each made from this build."""

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build"
sys.path.append(str(ROOT / "packaging"))
import make_wheel  # noqa: E402

CMAKE = Path(sys.executable).with_name("cmake")


def run(*command, folder=ROOT, status=0, **environment):
    """A command's output; its paths find neither this checkout nor anything by the environment."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        list(map(str, command)),
        cwd=folder,
        env={**kept, "PATH": f"{CMAKE.parent}:{kept['PATH']}", **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == status, (done.returncode, done.stdout[-2000:] + done.stderr[-4000:])
    return done


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    prefix = tmp_path_factory.mktemp("prefix")
    run(CMAKE, "--install", BUILD, "--component", "cpp", "--prefix", prefix)
    return prefix


def test_the_installed_headers_include_no_others(installed):
    headers = {str(path.relative_to(installed / "include")) for path in installed.glob("include/**/*.h")}
    assert "prdp/prdp.h" in headers
    for header in headers:
        wanted = re.findall(r'#include "(prdp/.*)"', (installed / "include" / header).read_text())
        assert set(wanted) <= headers, header


def test_the_examples_build_with_the_installed_package_and_run(installed, tmp_path):
    prefixes = f"{installed};{torch.utils.cmake_prefix_path}"
    run(
        CMAKE, "-S", ROOT / "examples" / "cpp", "-B", tmp_path, "-G", "Ninja", f"-DCMAKE_PREFIX_PATH={prefixes}"
    )  # fmt: skip
    run(CMAKE, "--build", tmp_path, "--parallel", 2)

    gradient = run(tmp_path / "heat_gradient")
    residuals = [float(r) for r in re.findall(r"K = \d+: residual (\S+),", gradient.stdout)]
    assert len(residuals) == 4 and residuals[-1] < residuals[0] < 1
    # The error of its last line, without torch's stack trace.
    assert gradient.stderr == "heat_gradient: Heat: expected (batch, 1, 30), got (4, 30)\n"

    found = [[float(x) for x in line] for line in re.findall(
        r"loss (\S+), error of kappa (\S+)", run(tmp_path / "own_equation").stdout)]  # fmt: skip
    assert len(found) == 3 and found[-1][0] < 1e-2 * found[0][0] and found[-1][1] < 0.1 < found[0][1], found

    trained = run(tmp_path / "train_network").stdout
    epochs = [(float(error), int(k)) for error, k in re.findall(r"error (\S+), K = (\d+)", trained)]
    assert len(epochs) == 7 and epochs[0][1] == 1 and epochs[-1][1] > 1
    assert epochs[-1][0] < 0.3 * epochs[0][0] and [k for _, k in epochs] == sorted(k for _, k in epochs)


def test_the_package_refuses_another_release_of_torch(installed, tmp_path):
    torch_folder = tmp_path / "share" / "cmake" / "Torch"
    torch_folder.mkdir(parents=True)
    (torch_folder / "TorchConfig.cmake").touch()
    (torch_folder / "TorchConfigVersion.cmake").write_text("set(PACKAGE_VERSION 2.99.1)")
    refused = run(CMAKE, "-S", ROOT / "examples" / "cpp", "-B", tmp_path / "build", "-G", "Ninja",
                  f"-DCMAKE_PREFIX_PATH={installed};{tmp_path}", status=1)  # fmt: skip
    here = ".".join(torch.__version__.split(".")[:2])
    said = " ".join(refused.stderr.split())
    assert f"prdp: was built with PyTorch {here}, found 2.99 in {torch_folder}" in said, said


def test_a_project_may_do_without_the_package(installed, tmp_path):
    """Where it is not REQUIRED, a torch that does not fit is no error, and the project's own variables stay."""
    (tmp_path / "CMakeLists.txt").write_text("""
cmake_minimum_required(VERSION 3.18)
project(optional LANGUAGES CXX)
set(PACKAGE_VERSION 0.1)
find_package(prdp QUIET)
message(STATUS "found ${prdp_FOUND}: ${PACKAGE_VERSION} ${prdp_NOT_FOUND_MESSAGE}")
""")

    def said(prefixes):
        configured = run(CMAKE, "-S", tmp_path, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={prefixes}", "--fresh")
        return re.search(r"found .*", configured.stdout)[0].strip()

    assert said(installed).startswith("found 0: 0.1 prdp: LibTorch was not found")
    assert said(f"{installed};{torch.utils.cmake_prefix_path}") == "found 1: 0.1"


def shown_symbols(library):
    """The names, with their namespaces alone, that other libraries can find in this one."""
    listed = run("nm", "--dynamic", "--defined-only", "--demangle", library).stdout
    for line in listed.splitlines():
        name = line.split(maxsplit=2)[2]
        while name != (name := re.sub(r"\([^()]*\)|<[^<>]*>", "", name)):  # arguments, of templates and of functions
            pass
        yield re.sub(r" const\b|\[.*", "", name).split()[-1]


def test_libraries_show_no_symbols_but_their_own():
    """What they hold of torch, Eigen and libstdc++ must not take the place of what other libraries hold of them: where
    the compiler links libstdc++ statically, streams of two copies crashed."""
    own = set(shown_symbols(BUILD / "libprdp.so"))
    assert "prdp::linear_solve" in own and "prdp::Heat::Heat" in own
    of_prdp = ("prdp::", "_ZN4prdp", "_ZNK4prdp")  # which is how the demangler leaves what it does not know
    assert {name for name in own if not name.startswith(of_prdp)} == set()
    for folder in (BUILD, BUILD / "experiments"):
        (module,) = folder.glob("_C.*.so")
        assert set(shown_symbols(module)) == {"PyInit__C"}


def setup(tmp_path, *commands):
    run(
        sys.executable, "setup.py", "-q", "egg_info", "--egg-base", tmp_path, *commands, PRDP_BUILD_DIR=str(BUILD)
    )  # fmt: skip


def test_the_source_archive_can_be_built(tmp_path):
    """It holds what git knows of these folders, and CMake, which looks for every source file, accepts it."""
    setup(tmp_path, "sdist", "--dist-dir", tmp_path)
    (archive,) = tmp_path.glob("*.tar.gz")
    run("tar", "-xzf", archive, "-C", tmp_path)
    (source,) = (path for path in tmp_path.glob("prdp_torch-*") if path.is_dir())

    def files(root):
        names = ("cmake", "csrc", "examples", "packaging", "prdp_torch")
        found = {path.relative_to(root) for name in names for path in (root / name).rglob("*") if path.is_file()}
        made = {".so", ".pyc"}
        return {path for path in found if path.suffix not in made and path.name != "built_for_torch.txt"}

    assert files(source) == files(ROOT) and not list(source.rglob("*.so"))
    assert {"CMakeLists.txt", "README.md", "pyproject.toml", "setup.py"} <= {path.name for path in source.iterdir()}
    run(CMAKE, "-S", source, "-B", tmp_path / "build", "-G", "Ninja", f"-DPython_EXECUTABLE={sys.executable}")


def needed(library):
    """The libraries that it asks for."""
    return set(re.findall(r"\(NEEDED\)\s+Shared library: \[(.*?)\]", run("readelf", "--dynamic", library).stdout))


def test_the_wheel_works_in_an_environment_of_its_own(tmp_path, monkeypatch):
    """As it is made for the CPU and for CUDA. The first program of the README runs with it."""
    monkeypatch.setenv("PRDP_BUILD_DIR", str(BUILD))
    monkeypatch.setenv("PATH", f"{CMAKE.parent}:{os.environ['PATH']}")
    release = torch.__version__.partition("+")[0]
    wheel = make_wheel.build(tmp_path)
    assert re.fullmatch(rf"prdp_torch-[\d.]+\+torch{re.escape(release)}-cp3\d+-cp3\d+-linux_\w+\.whl", wheel.name)
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        assert f"Requires-Dist: torch=={release}\n" in archive.read(metadata).decode()
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "fresh")
    python = tmp_path / "fresh" / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel)
    (packages,) = (tmp_path / "fresh" / "lib").glob("python*/site-packages")
    libraries = [*(packages / "prdp_torch").rglob("*.so")]
    asked = set.union(*map(needed, libraries)) - {library.name for library in libraries}
    of_the_system = {"libstdc++.so.6", "libm.so.6", "libgcc_s.so.1", "libc.so.6", "ld-linux-x86-64.so.2"}
    assert len(libraries) == 3 and asked - of_the_system == set(make_wheel.TORCH)  # none of CUDA's
    # Torch and the others come from here: no network. An editable installation among them is not followed.
    (packages / "others.pth").write_text(str(Path(torch.__file__).parents[1]))
    program = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    where = """
assert solve.info.solved.all() and error < 0.2
from prdp_torch.experiments import scenes
print(prdp.__file__, *map(str, scenes.available().values()))
"""
    *_, found = run(python, "-c", program + where, folder=tmp_path).stdout.splitlines()
    assert len(found.split()) > 5 and all(path.startswith(str(packages)) for path in found.split())
    listed = run(tmp_path / "fresh" / "bin" / "prdp", "scenes", folder=tmp_path).stdout
    assert "heat_1d" in listed and "navier_stokes" in listed


WITHOUT_EXPERIMENTS = """
import sys
for name in ("h5py", "jinja2", "matplotlib", "rich", "tensorboard", "typer"):
    sys.modules[name] = None
"""


def test_the_library_needs_torch_alone():
    """The other packages are for the experiments: the command, charts and reports."""
    solved = """
import torch, prdp_torch as prdp
from prdp_torch.experiments.refinement import Refinement
from prdp_torch.experiments.training import train
heat = prdp.Heat((30,), 1e-3, 1.0, prdp.CG(1))
controller = prdp.PRDPController([heat])
heat(torch.randn(2, 1, 30, requires_grad=True)).sum().backward()
print(prdp.advise(heat, torch.randn(2, 1, 30), seconds=0.02).recommendation)
scene = prdp.experiments.scenes.load("heat_1d")
scene.training.intervals = 1
print(train(scene, Refinement.auto())["metric"])
"""
    *_, metrics = run(sys.executable, "-c", WITHOUT_EXPERIMENTS + solved).stdout.splitlines()
    assert len(json.loads(metrics)) == 2


def test_the_command_names_what_it_misses():
    command = [sys.executable, "-c", WITHOUT_EXPERIMENTS + "import prdp_command; prdp_command.main()"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 2
    assert "the command needs pip install 'prdp_torch[experiments]'" in done.stderr
    assert "Traceback" not in done.stderr
