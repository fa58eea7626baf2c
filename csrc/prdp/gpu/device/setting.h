#pragma once
#include <cstdint>

/// What the text of a solve's kernel is made for.
namespace prdp::gpu {

/// Constants of a kernel.
template <class Number, class Operator, int blocks, int threads, int vectors, int vectors_in_block, bool by_diagonal,
          bool divides_by_diagonal, int bytes_of_arrays, int restart, class WithCycles>
struct Setting {
  using T = Number;                                 // float or double
  using A = Operator;                               // of views.h
  static constexpr int kBlocks = blocks;            // that work on one sample
  static constexpr int kThreads = threads;          // in each
  static constexpr int kVectors = vectors;          // of a sample
  static constexpr int kInBlock = vectors_in_block; // the first so many of them lie in the block's own memory
  static constexpr bool kByDiagonal = by_diagonal;  // the preconditioner is the diagonal
  static constexpr bool kDividesByDiagonal = divides_by_diagonal;  // by it, or by the method
  static constexpr int kBytesOfArrays = bytes_of_arrays;  // that the method keeps
  static constexpr int kRestart = restart;          // of GMRES
  using Cycles = WithCycles;                        // the preconditioner is a V-cycle (cycle.h)
  static_assert(blocks == 1 || vectors_in_block == 0);
};

/// A few numbers in a thread's own memory.
template <class X>
class Slice {
 public:
  Slice(X* first, int64_t n) : first_(first) { PRDP_NO_UNROLL for (int64_t i = 0; i < n; ++i) first_[i] = X{}; }
  X& operator[](int64_t i) { return first_[i]; }
  const X& operator[](int64_t i) const { return first_[i]; }
  X* data() { return first_; }
  const X* data() const { return first_; }

 private:
  X* first_;
};

}  // namespace prdp::gpu
