#pragma once
#include <cstdint>

/// What a kernel is called with. The host and the kernel read the same text.
namespace prdp::gpu {

/// Vectors that A, or Aᵀ, maps to zero: orthonormal ones of `length` entries, in each of `fields` parts of a sample
/// from the `first` on.
template <class T>
struct NullSpaceArguments {
  const T* basis;  // (count, length); null: the constant vector
  int64_t count;   // 0: there is none
  int64_t first, fields, length;
};

inline constexpr int kMostTensors = 8, kMostNumbers = 10;
/// The tensors and numbers of an operator; its view says what each of them is.
struct OperatorArguments {
  const void* tensors[kMostTensors];         // null where there is none
  int64_t sample_strides[kMostTensors];      // entries between two samples; 0: they share the tensor
  double numbers[kMostNumbers];
};

template <class T>
struct SolveArguments {
  OperatorArguments a;
  NullSpaceArguments<T> null_space, left_null_space;
  const T *b, *x0;      // (batch, unknowns); no start: null
  T* u;                 // (batch, unknowns)
  const int64_t* caps;  // (batch,); null: all have max_iter
  int64_t* counts;      // (3, batch): iterations, status, products
  T* reals;             // (2, batch): relative residual, floor
  T* memory;            // vectors that do not fit into a block, and what damping needs, for each team
  unsigned* arrived;    // of each team, 32 apart
  double* parts;        // of the sums of each team
  int64_t batch, max_iter;
  double rtol;
  int64_t guarded;
  int64_t leaks;  // products leave the range of A by their rounding, and are projected
};

/// Numbers of a team beyond its vectors: for the damped least squares of GMRES.
constexpr int64_t numbers_beyond(int64_t restart) { return restart * (restart + 3); }

/// Vectors of a sample that the space itself keeps: b, scratch; and with a start, the start and b - A start.
inline constexpr int kOwnVectors = 4;

/// Blocks of a team keep their parts of so many sums at once.
inline constexpr int kMostAtOnce = 4;

}  // namespace prdp::gpu
