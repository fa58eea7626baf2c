"""The kernels of a GPU on the CPU. While a `Fibers` is entered, solves of CPU tensors take the way of a GPU: the same
text is compiled by the host's compiler, and its threads run as fibers (tests/fibers/fibers.h)."""

import ctypes
import os
import pathlib

import prdp_torch  # noqa: F401  the library that the fibers are linked against

ROOT = pathlib.Path(__file__).parents[2]
ORDERS = FORWARD, BACKWARD, SHUFFLED = range(3)


class Fibers:
    """A device whose blocks have so much memory, and teams of one block for so many unknowns."""

    def __init__(self, block_memory=96 << 10, cells=16384, threads=64, order=FORWARD, left_out=0):
        self.settings = (block_memory, cells, threads, order, left_out)

    @staticmethod
    def library():
        library = ctypes.CDLL(str(ROOT / "build" / "libprdp_fibers.so"))
        library.prdp_compile_last.argtypes = [ctypes.c_int, ctypes.POINTER(ctypes.c_int64)]
        library.prdp_compile_last.restype = ctypes.c_char_p
        library.prdp_resources_of_last.restype = ctypes.c_char_p
        library.prdp_fibers_launches.restype = ctypes.c_int64
        library.prdp_compile_loops.argtypes = [ctypes.c_int, ctypes.POINTER(ctypes.c_int64)]
        library.prdp_compile_loops.restype = ctypes.c_char_p
        library.prdp_fibers_begin.argtypes = [ctypes.c_int64] * 3 + [ctypes.c_int] * 2
        return library

    def compile_last(self, capability):
        """Compile the text of the kernel that ran last by NVRTC; returns the length of the binary, and what failed."""
        size = ctypes.c_int64()
        error = self.library().prdp_compile_last(capability, ctypes.byref(size))
        return size.value, error.decode()

    def launches(self):
        """How many kernels were launched so far."""
        return self.library().prdp_fibers_launches()

    def compile_loops(self, capability):
        """Compile every kernel that is a loop and has run; returns how many, and what failed."""
        count = ctypes.c_int64()
        error = self.library().prdp_compile_loops(capability, ctypes.byref(count))
        return count.value, error.decode()

    def resources_of_last(self, capability):
        return self.library().prdp_resources_of_last(capability).decode()

    def __enter__(self):
        self.before = os.environ.get("PRDP_GPU")
        os.environ["PRDP_GPU"] = "required"
        self.library().prdp_fibers_begin(*self.settings)
        return self

    def __exit__(self, *_):
        self.library().prdp_fibers_end()
        if self.before is None:
            del os.environ["PRDP_GPU"]
        else:
            os.environ["PRDP_GPU"] = self.before
