"""Kernels are compiled by NVRTC, without a GPU, for the cards that are about; and what happens where they cannot be."""

import os
import re
import subprocess
import sys
import warnings

import pytest
import torch
from fibers import ROOT, Fibers, Kernel
from small_disk import file_size_limit
from test_gpu_flow import outcome
from test_gpu_kernels import OPERATORS, right_hand_sides, solve, solver
from test_gpu_products import gradients

import prdp_torch as prdp

F32 = torch.float32


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PRDP_CACHE", str(tmp_path))
    return tmp_path / "kernels"


def run_once(name="diffusion", method=prdp.CG):
    """A solve on the fibers; returns its kernel."""
    solve(OPERATORS[name](F32), right_hand_sides(name, F32), solver(method), {})
    return Fibers().kernels()[-1]


def test_kernels_compile_for_the_cards_that_are_about(cache):
    size, error = run_once("stencil", prdp.GMRES).compile(90)
    assert not error and size > 10_000
    kernel = run_once("heat 2D", prdp.Chebyshev)
    for capability in (80, 120):
        size, error = kernel.compile(capability)
        assert not error and size > 10_000
    newer, error = kernel.compile(199)  # of tomorrow: PTX, which its driver compiles
    assert not error and newer > 0
    assert "knows no device of compute capability 1.0" in kernel.compile(10)[1]


def test_the_kernels_of_a_flow_and_of_fields_compile(cache):
    outcome("channel", F32, steps=1)  # makes the masks
    with Fibers() as fibers:
        outcome("channel", F32, steps=1)
    kernels = fibers.kernels()
    for name in ("diffusion", "stencils", "burgers", "navier-stokes"):
        gradients(name, F32, threads=32)
        kernels += fibers.kernels()
    loops = {kernel for kernel in kernels if "run_each.h" in kernel.text}
    assert len(loops) == 12 and not any(error for _, error in (kernel.compile(90) for kernel in loops))


def test_a_damaged_file_is_made_again_and_no_folder_is_no_fault(cache, monkeypatch):
    kernel = run_once("heat 1D", prdp.SteepestDescent)
    size, _ = kernel.compile(90)
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    for damaged in (whole[:100], whole[:-1] + b"?"):
        file.write_bytes(damaged)
        assert kernel.compile(90) == (size, "") and file.read_bytes() == whole
    assert [f.name for f in cache.iterdir()] == [file.name]
    monkeypatch.setenv("PRDP_CACHE", str(file / "below a file"))
    assert kernel.compile(90) == (size, "")


TRIVIAL = Kernel('extern "C" __global__ void prdp_kernel() {}', 0)


def test_no_room_and_no_home_are_no_fault(cache, monkeypatch):
    with file_size_limit(100):
        size, error = TRIVIAL.compile(90)
    assert not error and size > 100 and not list(cache.iterdir())  # no half of a file either
    assert TRIVIAL.compile(90) == (size, "") and len(list(cache.iterdir())) == 1
    monkeypatch.delenv("PRDP_CACHE")
    monkeypatch.setenv("HOME", "/proc/self")  # where nobody may write
    assert TRIVIAL.compile(90) == (size, "")


AT_ONCE = """
import sys
sys.path.insert(0, "tests/python")
from test_gpu_compiler import TRIVIAL
print("ready", flush=True)
input()
for capability in (80, 90, 120):
    print(TRIVIAL.compile(capability))
"""


def test_two_processes_that_compile_the_same_at_once(cache):
    command = [sys.executable, "-W", "ignore", "-c", AT_ONCE]
    both = [
        subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(2)
    ]
    assert [one.stdout.readline() for one in both] == ["ready\n"] * 2
    for one in both:
        one.stdin.write("go\n")
        one.stdin.flush()
    said = [one.communicate()[0] for one in both]
    alone = "".join(f"{TRIVIAL.compile(capability)}\n" for capability in (80, 90, 120))
    assert said == [alone] * 2 and "''" in alone and len(list(cache.iterdir())) == 3


def test_what_has_no_kernel_is_said_where_kernels_are_required():
    a, b = OPERATORS["heat 2D"](F32), right_hand_sides("heat 2D", F32)
    with pytest.raises(RuntimeError, match=r"PRDP_GPU=required: Direct has no kernel"):
        solve(a, b, prdp.Direct(), {})
    with pytest.raises(RuntimeError, match="PRDP_GPU=required: this operator has no kernel"):
        solve(prdp.operators.Function(lambda v: 2 * v, symmetric=True), b, prdp.CG(max_iter=5), {})
    with Fibers(), warnings.catch_warnings():
        warnings.simplefilter("error")
        for value in ("auto", "off", ""):
            os.environ["PRDP_GPU"] = value
            u, _ = prdp.linear_solve(a, b, solver=prdp.Direct())
        assert (a.apply(u) - b).norm() <= 1e-4 * b.norm()
        os.environ["PRDP_GPU"] = "perhaps"
        with pytest.raises(ValueError, match='PRDP_GPU: expected "auto", "required" or "off", got "perhaps"'):
            prdp.linear_solve(a, b, solver=prdp.CG(max_iter=20))


def test_warm_up_names_what_it_made():
    step = prdp.Heat((23,), nu=1e-3, dt=1.0, solver=prdp.CG(max_iter=5))
    state = torch.randn(2, 1, 23, requires_grad=True)
    assert prdp.warm_up(step, state) == []  # on the CPU there is nothing to make
    with Fibers():
        assert prdp.warm_up(step, state) == ["CG of Laplacian<float, Grid<1, 1, 23>>"]
        assert prdp.warm_up(step, state) == []
    assert state.grad is None


@pytest.mark.parametrize("name", ["kappa", "nu", "winds", "pressure"])
def test_after_a_warm_up_no_gradient_of_a_parameter_makes_a_kernel(name):
    """As after it a CUDA graph is captured."""
    positive = torch.rand(1, 7, 11, dtype=torch.float64) + 1
    leaf = (positive if name == "kappa" else 0.01 * positive[0, 0, 0]).clone().requires_grad_()
    solver = prdp.CG(max_iter=50)
    step = {
        "kappa": lambda: prdp.ImplicitStep(prdp.operators.Diffusion(leaf, shift=10.0), solver=solver),
        "nu": lambda: prdp.Heat((7, 11), leaf, 1.0, solver=solver),
        "winds": lambda: prdp.Burgers((7, 11), nu=leaf, dt=0.01, solver=prdp.BiCGStab(50)),
        "pressure": lambda: prdp.Flow((8, 8), dt=0.01, nu=leaf, solver=solver).step_and_pressure,
    }[name]()
    shape = {"winds": (2, 2, 7, 11), "pressure": (2, 2, 8, 8)}.get(name, (2, 1, 7, 11))
    state = 0.1 * torch.randn(shape, dtype=torch.float64)
    with Fibers():
        assert prdp.warm_up(step, state)
        before = prdp._C.kernels_made()
        u = step(state)
        u, *_ = (u,) if isinstance(u, torch.Tensor) else u
        u.square().sum().backward()
        assert prdp._C.kernels_made() == before
    assert leaf.grad.abs().sum() > 0


WITHOUT_NVRTC = """
import sys
sys.path.insert(0, "tests/python")
from test_gpu_compiler import run_once
print(run_once().compile(90)[1])
"""


def test_a_machine_without_nvrtc_is_told_what_to_install():
    environment = {**os.environ, "PRDP_NVRTC": "/nowhere/libnvrtc.so"}
    command = [sys.executable, "-c", WITHOUT_NVRTC]
    said = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout
    assert "there is no NVRTC: pip install nvidia-cuda-nvrtc" in said


WHY = """
import sys
sys.path.insert(0, "tests/python")
from fibers import Fibers
print(getattr(Fibers.library(), sys.argv[1])(*[int(a) if a.isdigit() else a.encode() for a in sys.argv[2:]]).decode())
"""


@pytest.fixture
def ask(tmp_path):
    """Of a program whose driver is tests/fibers/fake_driver.c, built with these options."""

    def build_and_ask(question, *options, **environment):
        driver = tmp_path / "libcuda.so.1"
        fake = ROOT / "tests/fibers/fake_driver.c"
        subprocess.run(["cc", "-shared", "-fPIC", *options, str(fake), "-o", str(driver)], check=True)
        environment = {**os.environ, "LD_LIBRARY_PATH": str(tmp_path), **environment}
        command = [sys.executable, "-c", WHY, *map(str, question)]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    return build_and_ask


# A torch with CUDA has loaded its own driver, and has its own guard of the device.
with_a_driver_of_our_own = pytest.mark.skipif(torch.version.cuda is not None, reason="the device is torch's own")


def test_a_driver_that_refuses_is_quoted(ask):
    said = "the driver does not start: CUDA driver version is insufficient for CUDA runtime version (35)"
    assert said in ask(["prdp_why_no_cuda"])
    assert "cuLaunchCooperativeKernel" in ask(["prdp_why_no_cuda"], "-DWITHOUT_NEWER")


@with_a_driver_of_our_own
def test_a_driver_that_captures_and_a_device_without_room(ask, cache):
    assert TRIVIAL.compile(90)[1] == ""  # and is kept: NVRTC does not work beside a driver like this one
    why = ["prdp_why_no_kernel_of_cuda", TRIVIAL.text]
    assert ask([*why, 1], "-DWORKS") == ""
    assert ask([*why, 1], "-DWORKS", CROWDED="1") == "the device has no room for a block of this kernel"
    said = ask([*why, 1], "-DWORKS", CAPTURING="1")
    assert "a kernel is to be compiled while a CUDA graph is captured; call prdp.warm_up() before" in said


@with_a_driver_of_our_own
def test_a_kernel_that_did_not_load_for_want_of_memory_is_tried_again(ask, cache):
    assert TRIVIAL.compile(90)[1] == ""
    why = ["prdp_why_no_kernel_of_cuda", TRIVIAL.text]
    assert ask([*why, 1], "-DWORKS", SHORT="1") == ""  # at once, after torch has let go of what it keeps
    assert ask([*why, 1], "-DWORKS", SHORT="2") == "the kernel does not load: out of memory (2)"
    assert ask([*why, 2], "-DWORKS", SHORT="2") == ""


@with_a_driver_of_our_own
@pytest.mark.parametrize("device", [0, 1])
def test_a_launch_from_a_thread_without_a_context(ask, cache, device):
    """Teams of several blocks wait for each other, so theirs is cooperative."""
    assert TRIVIAL.compile(90)[1] == ""
    for blocks, how in ((1, "launch of 2"), (2, "cooperative launch of 4")):
        assert ask(["prdp_launch_on_cuda", TRIVIAL.text, blocks, device], "-DWORKS") == (
            f"{how} blocks of 64 threads with 60000 bytes in context {1 + device} on stream {100 * device + 7}, "
            "argument 42"
        )


@with_a_driver_of_our_own
def test_nvrtc_is_that_of_the_version_of_the_driver(ask, tmp_path, cache):
    """As an older driver may not load what a newer NVRTC compiles."""
    for version, body in (("12", ""), ("13", "int nvrtcVersion(void) { return 0; }")):
        (tmp_path / "stub.c").write_text(body)
        stub = tmp_path / f"libnvrtc.so.{version}"
        subprocess.run(["cc", "-shared", "-fPIC", str(tmp_path / "stub.c"), "-o", str(stub)], check=True)
    why = ["prdp_why_no_kernel_of_cuda", TRIVIAL.text, 1]
    assert ask(why, "-DWORKS", VERSION="12080").endswith("it has no nvrtcVersion")
    assert ask(why, "-DWORKS", VERSION="13000").endswith("it has no nvrtcCreateProgram")


def test_a_solve_whose_kernel_cannot_be_made_is_done_by_tensor_operations():
    a, b = OPERATORS["heat 2D"](F32), right_hand_sides("heat 2D", F32)
    expected, report = solve(a, b, prdp.CG(max_iter=60, rtol=1e-5))
    no_room = "the device has no room for a block of this kernel"
    with Fibers() as fibers, warnings.catch_warnings(record=True) as said:
        fibers.library().prdp_fibers_refuse()
        warnings.simplefilter("always")
        with pytest.raises(RuntimeError, match=f"PRDP_GPU=required: {no_room}"):
            prdp.linear_solve(a, b, prdp.CG(max_iter=60, rtol=1e-5))
        os.environ["PRDP_GPU"] = "auto"
        for _ in range(2):
            u, info = prdp.linear_solve(a, b, prdp.CG(max_iter=60, rtol=1e-5))
    assert [no_room in str(warning.message) for warning in said] == [True]
    assert info.way != "kernel" and torch.equal(info.status, report.status)
    torch.testing.assert_close(u, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("multigrid", [False, True])
def test_a_sample_of_more_points_than_the_blocks_of_the_device_usually_take(multigrid):
    """Each takes more of them; a device of 46 multiprocessors has too few for 1024²."""
    a, b = OPERATORS["heat 2D"](F32), right_hand_sides("heat 2D", F32)
    method = prdp.CG(max_iter=60, rtol=1e-5, preconditioner="multigrid" if multigrid else None)
    expected, report = solve(a, b, method)
    for blocks in (2, 3):
        with Fibers(cells=16, most_blocks=blocks) as fibers:
            u, info = prdp.linear_solve(a, b, method)
        assert info.way == "kernel" and torch.equal(info.status, report.status)
        assert re.search(rf"Setting<float, Laplacian.*>, {blocks}, ", fibers.kernels()[-1].text)
        torch.testing.assert_close(u, expected, rtol=1e-4, atol=1e-5)


def test_a_sample_that_no_kernel_holds_is_named():
    said = Fibers.library().prdp_why_too_large(1 << 31).decode()
    assert said == "a sample of 2147483648 unknowns is too large for a kernel"


@pytest.mark.parametrize("backward", [True, False])
def test_a_warm_up_takes_whatever_a_step_returns(backward):
    n = 12 + backward  # a kernel that was not made before
    a, layer = prdp.operators.Heat((n,), 1e-2, 1.0), torch.nn.Linear(n, n, dtype=torch.float64)
    state = torch.randn(2, 1, n, dtype=torch.float64)
    steps = {
        "a solve": lambda u: prdp.linear_solve(a, u, prdp.CG(max_iter=7)),
        "nothing": lambda u: None,
        "a dict": lambda u: {"u": [layer(u), (u,)], "word": "x"},
        "a constant": lambda u: torch.ones(2),
    }
    with Fibers():
        made = {name: prdp.warm_up(step, state, backward) for name, step in steps.items()}
    assert [len(names) for names in made.values()] == [1, 0, 0, 0]
    assert layer.weight.grad is None
