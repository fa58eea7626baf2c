"""The kernels of a GPU on the CPU. While a `Fibers` is entered, solves of CPU tensors take the way of a GPU: the same
text is compiled by the host's compiler, and its threads run as fibers (tests/fibers/fibers.h)."""

import ctypes
import os
import pathlib
import re
from typing import NamedTuple

import torch

import prdp_torch  # noqa: F401  the library that the fibers are linked against

ROOT = pathlib.Path(__file__).parents[2]
BUILD = ROOT / os.environ.get("PRDP_BUILD_DIR", "build")  # which prdp_torch was built in
ORDERS = FORWARD, BACKWARD, SHUFFLED = range(3)


# Headers of kernels whose barriers these tests leave out; test_gpu_kernels.py takes all others.
WITH_BARRIERS = {"multigrid": {"cycle", "hierarchy", "pseudo_inverse", "saddle_point"}, "flow": {"flow_pressure"}}


def barriers(of=None):
    """Each one of these headers by its line, or, plus 10,000, by that of a call of meet(); those of the team first."""
    found, others = [], set().union(*WITH_BARRIERS.values())
    for header in sorted((ROOT / "csrc/prdp/gpu/device").glob("*.h"), key=lambda h: (h.stem != "team", h.stem)):
        if header.stem not in others if of is None else header.stem in WITH_BARRIERS[of]:
            for n, line in enumerate(header.read_text().splitlines(), 1):
                code = line.partition("//")[0]
                found += [n] if "__syncthreads()" in code else [10000 + n] if re.search(r"\bmeet\(\)", code) else []
    return found


class Kernel(NamedTuple):
    """A kernel that was asked for."""

    text: str
    block_memory: int  # bytes that a block is launched with, beside what the text declares

    def compile(self, capability):
        """By NVRTC; returns the length of the binary, and what failed."""
        size = ctypes.c_int64()
        error = Fibers.library().prdp_compile(self.text.encode(), capability, ctypes.byref(size))
        return size.value, error.decode()

    def resources(self, capability):
        return Fibers.library().prdp_resources_of(self.text.encode(), capability).decode()


class Fibers:
    """A device whose blocks have so much memory, and teams of one block for so many unknowns, but of `most_blocks` at
    most. Memory of a block, and what torch makes anew, begins as NaN, which takes an operation of torch,
    unless `poison` is False. With `captures`, its streams capture a graph. With `from_ptx` the fibers run the PTX that
    NVRTC makes of the text, instruction by instruction, in place of the text (tests/fibers/ptx.py)."""

    def __init__(
        self,
        block_memory=96 << 10,
        cells=16384,
        threads=64,
        order=FORWARD,
        left_out=0,
        most_blocks=132,
        poison=True,
        captures=False,
        from_ptx=False,
    ):
        self.settings = (block_memory, cells, threads, order, left_out, poison, captures, most_blocks, from_ptx)
        self.poison = poison

    @staticmethod
    def library():
        library = ctypes.CDLL(str(BUILD / "libprdp_fibers.so"))
        library.prdp_fibers_begin.argtypes = (
            [ctypes.c_int64] * 3 + [ctypes.c_int] * 2 + [ctypes.c_bool] * 2 + [ctypes.c_int64, ctypes.c_bool]
        )
        library.prdp_fibers_launches.restype = ctypes.c_int64
        library.prdp_fibers_kernels.restype = ctypes.c_int64
        library.prdp_text_of.argtypes = library.prdp_block_memory_of.argtypes = [ctypes.c_int64]
        library.prdp_text_of.restype = ctypes.c_char_p
        library.prdp_block_memory_of.restype = ctypes.c_int64
        library.prdp_compile.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.POINTER(ctypes.c_int64)]
        library.prdp_resources_of.argtypes = [ctypes.c_char_p, ctypes.c_int]
        library.prdp_why_no_kernel_of_cuda.argtypes = [ctypes.c_char_p, ctypes.c_int64]
        library.prdp_launch_on_cuda.argtypes = [ctypes.c_char_p, ctypes.c_int64, ctypes.c_int64]
        library.prdp_why_too_large.argtypes = [ctypes.c_int64]
        texts = "compile resources_of why_no_cuda why_no_kernel_of_cuda launch_on_cuda why_too_large"
        for name in texts.split():
            getattr(library, f"prdp_{name}").restype = ctypes.c_char_p
        return library

    def launches(self):
        """How many kernels were launched so far."""
        return self.library().prdp_fibers_launches()

    def kernels(self):
        """Those that were asked for since fibers were last entered, each once."""
        library = self.library()
        return [
            Kernel(library.prdp_text_of(n).decode(), library.prdp_block_memory_of(n))
            for n in range(library.prdp_fibers_kernels())
        ]

    def __enter__(self):
        self.before = os.environ.get("PRDP_GPU"), torch.are_deterministic_algorithms_enabled()
        os.environ["PRDP_GPU"] = "required"
        if self.poison:
            torch.use_deterministic_algorithms(True)
        self.library().prdp_fibers_begin(*self.settings)
        return self

    def __exit__(self, *_):
        self.library().prdp_fibers_end()
        use, deterministic = self.before
        torch.use_deterministic_algorithms(deterministic)
        if use is None:
            del os.environ["PRDP_GPU"]
        else:
            os.environ["PRDP_GPU"] = use
