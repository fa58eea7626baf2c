"""What NVRTC makes of kernels, run on the CPU instruction by instruction (tests/fibers/ptx.py): the bits must be those
of the text. A few of all kernels; `PRDP_PTX=1 pytest tests/python/test_cuda.py` takes them all."""

import ctypes
import subprocess
import sys

import pytest
import test_cuda
import test_gpu_multigrid as multigrid
import torch
from fibers import ROOT
from test_gpu_kernels import OPERATORS, right_hand_sides, solver

import prdp_torch as prdp

F32, F64 = torch.float32, torch.float64
FOLDER = ROOT / "tests" / "fibers"


@pytest.fixture(autouse=True)
def from_ptx(monkeypatch):
    monkeypatch.setenv("PRDP_PTX", "1")


@pytest.mark.parametrize(
    ("name", "method", "dtype"),
    [
        ("heat 2D", prdp.CG, F32),
        ("sparse", prdp.BiCGStab, F64),
        ("burgers", prdp.Jacobi, F64),
        ("closed", prdp.MINRES, F32),
        ("navier-stokes", prdp.GMRES, F32),
    ],
)
def test_a_kernel_gives_the_bits_of_its_text(name, method, dtype):
    a, b = OPERATORS[name](dtype), right_hand_sides(name, dtype)
    test_cuda.assert_the_bits_of_fibers(test_cuda.solved(a, b, solver(method, rtol=1e-3, max_iter=20)))


def test_cycles_and_coarse_grids_too():
    a, b = multigrid.OPERATORS["winds"][0](F32), multigrid.right_hand_sides("winds", F32)
    of = multigrid.with_cycles(prdp.BiCGStab, max_iter=3, rtol=1e-3)
    test_cuda.assert_the_bits_of_fibers(test_cuda.solved(a, b, of))


def test_a_team_of_blocks_too():
    test_cuda.test_a_team_of_blocks_gives_the_bits_of_the_fibers(prdp.CG(3, 0.0))


FORGED = r"""
.version 8.0
.target sm_80
.address_size 64
.visible .entry prdp_kernel(.param .align 8 .b8 prdp_kernel_param_0[8])
{
  .reg .pred %p<3>;
  .reg .b16 %rs<3>;
  .reg .b32 %r<12>;
  .reg .b64 %rd<12>;
  .reg .f32 %f<4>;
  .reg .f64 %fd<6>;
  ld.param.u64 %rd1, [prdp_kernel_param_0];
  cvta.to.global.u64 %rd2, %rd1;
  mov.u32 %r1, %tid.x;
  mul.wide.u32 %rd3, %r1, 128;
  add.s64 %rd4, %rd2, %rd3;
  mov.b32 %r2, -7;
  div.s32 %r3, %r2, 2;
  shr.s32 %r4, %r2, 40;
  shr.u32 %r5, %r2, 40;
  st.global.v2.u32 [%rd4], {%r3, %r4};
  st.global.u32 [%rd4+8], %r5;
  mul.hi.u32 %r6, %r2, 16;
  st.global.u32 [%rd4+12], %r6;
  mov.f64 %fd1, 0d7FF8000000000000;
  mov.f64 %fd2, 0d4004000000000000;
  max.f64 %fd3, %fd1, %fd2;
  st.global.f64 [%rd4+16], %fd3;
  setp.ltu.f64 %p1, %fd1, %fd2;
  setp.ne.f64 %p2, %fd1, %fd2;
  selp.u32 %r7, 1, 0, %p1;
  selp.u32 %r8, 1, 0, %p2;
  st.global.v2.u32 [%rd4+24], {%r7, %r8};
  cvt.rni.s32.f64 %r9, %fd2;
  cvt.rzi.s32.f64 %r10, %fd1;
  st.global.v2.u32 [%rd4+32], {%r9, %r10};
  cvt.rn.f32.f64 %f1, %fd2;
  fma.rn.f32 %f2, %f1, %f1, %f1;
  st.global.f32 [%rd4+40], %f2;
  prmt.b32 %r11, %r2, 305419896, 0x4F10;
  st.global.u32 [%rd4+44], %r11;
  mov.b64 %rd5, {%r3, %r4};
  st.global.u64 [%rd4+48], %rd5;
  cvt.u16.u32 %rs1, %r2;
  st.global.u16 [%rd4+56], %rs1;
  clz.b64 %r3, %rd3;
  st.global.u32 [%rd4+60], %r3;
  shfl.sync.bfly.b32 %r4|%p1, %r1, 1, 31, -1;
  bar.sync 0;
  @%p2 bra $OUT;
  st.global.u32 [%rd4+64], %r4;
$OUT:
  ret;
}
"""


def translated(ptx, tmp_path, status=0):
    """Its C++, or what is said of it."""
    source, result = tmp_path / "forged.ptx", tmp_path / "forged.cpp"
    source.write_text(ptx)
    done = subprocess.run([sys.executable, FOLDER / "ptx.py", source, result], capture_output=True, text=True)
    assert done.returncode == status, done.stderr
    return done.stderr if status else result


def test_instructions_do_what_the_language_says(tmp_path):
    """Quotients cut towards zero, long shifts keep the sign or nothing, NaN gives way, is unordered and becomes
    the highest bit, halves go to the even neighbour."""
    library = tmp_path / "forged.so"
    command = ["c++", "-std=c++20", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-pthread", f"-I{FOLDER}"]
    subprocess.run([*command, translated(FORGED, tmp_path), "-o", library], check=True)
    lanes = 32
    out = torch.zeros(lanes, 128, dtype=torch.uint8)
    arguments = ctypes.c_void_p(out.data_ptr())
    ctypes.CDLL(str(library)).run(ctypes.byref(arguments), 1, lanes, ctypes.c_long(64), 0, 0, True)

    def read(lane, begin, end, dtype):
        return out[lane, begin:end].view(dtype).tolist()

    assert read(1, 0, 16, torch.int32) == [-3, -1, 0, 15]
    assert read(1, 16, 24, F64) == [2.5]
    assert read(1, 24, 40, torch.int32) == [1, 0, 2, -(2**31)]
    assert read(1, 40, 44, F32) == [8.75]
    assert read(1, 44, 48, torch.uint32) == [0x7800FFF9]
    assert read(1, 48, 56, torch.int32) == [-3, -1]
    assert read(1, 56, 58, torch.uint16) == [65529]
    assert [read(lane, 60, 64, torch.int32)[0] for lane in (0, 1, 2)] == [64, 56, 55]
    assert [read(lane, 64, 68, torch.int32)[0] for lane in (0, 1, 2, 31)] == [1, 0, 3, 30]


def test_an_instruction_whose_bits_are_not_defined_is_refused(tmp_path):
    said = translated(FORGED.replace("max.f64 %fd3, %fd1, %fd2", "rsqrt.approx.ftz.f64 %fd3, %fd1"), tmp_path, status=1)
    assert "rsqrt.approx.ftz.f64 %fd3, %fd1: Unknown" in said
