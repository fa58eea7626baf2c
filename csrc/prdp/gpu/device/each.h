#pragma once
/// Loops that are kernels. What is called for a point, or for a sample by a team of threads, is a struct with its
/// tensors and numbers: the host fills it in, and the kernel is called with it.
namespace prdp::gpu {

/// of(i) for i = 0 … count - 1, in any order.
template <class Of>
struct EachPoint {
  Of of;
  int count;
};

/// of(sample, team) for all samples of a batch.
template <class Of>
struct EachSample {
  Of of;
  int batch;
  unsigned* arrived;  // of each team
  double* parts;      // of the sums of each team
};

}  // namespace prdp::gpu
