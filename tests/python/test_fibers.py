"""The fibers that stand for the threads of a GPU: what a kernel must not do is noticed."""

import subprocess

from fibers import ROOT

FORGED = r"""
#include "fibers.h"

#include "prdp/gpu/device/team.h"

#include <cstdio>

__device__ bool shared_begins_as_nan() {
  __shared__ double sums[4];
  const bool is_nan = std::isnan(sums[0]) && std::isnan(sums[3]);
  __syncthreads();
  sums[threadIdx.x % 4] = 1.0;
  return is_nan;
}
std::atomic<int> as_expected;
void forged(int kind) {
  const bool half = threadIdx.x < 32;
  prdp::gpu::Team<1, 64> team(0, nullptr, nullptr);
  switch (kind) {
    case 0:  // as it should be
      team.meet();
      as_expected += shared_begins_as_nan() && std::isnan(fibers::block->of_lanes[threadIdx.x]);
      as_expected -= team.sum(1.0) != 64.0;
      return;
    case 1:  // some do not come
      if (half) __syncthreads();
      return;
    case 2:  // to different barriers
      if (half) __syncthreads();
      else
        __syncthreads();
      return;
    case 3:  // to the same one, called by different lines
      if (half) team.meet();
      else
        team.meet();
      return;
    case 4:  // a warp to a barrier, whose lanes are in a sum
      if (threadIdx.x % 2) team.meet();
      else
        team.sum(1.0);
  }
}
int main() {
  for (int order = 0; order < 3; ++order)
    for (int kind : {0, 0, 1, 2, 3, 4}) {
      as_expected = 0;
      const auto run = [&] { forged(kind); };
      const bool regular = fibers::launch(2, 64, 0, static_cast<fibers::Order>(order), 7, run);
      std::printf("%d%d%s ", kind, regular, kind == 0 && as_expected != 128 ? "?" : "");
    }
}
"""


def test_what_a_kernel_must_not_do_is_noticed(tmp_path):
    """In three orders. What one launch left in the memory of a block is not there in the next."""
    source, program = tmp_path / "forged.cpp", tmp_path / "forged"
    source.write_text(FORGED)
    folders = [f"-I{ROOT / name}" for name in ("tests/fibers", "csrc")]
    command = ["c++", "-std=c++20", "-O1", "-pthread", *folders, source, "-o", program]
    subprocess.run(list(map(str, command)), check=True)
    said = subprocess.run([program], capture_output=True, text=True, check=True, timeout=60).stdout
    assert said.split() == ["01", "01", "10", "20", "30", "40"] * 3
