#pragma once
#include <cstdint>

#include "prdp/solvers/batch_arrays.h"

/// What a kernel is called with. The host and the kernel read the same text.
namespace prdp::gpu {

/// A null space of A, or of Aᵀ: `count` orthonormal vectors of `length` entries. Each applies to every one of `fields`
/// consecutive parts of a sample, starting with part `first`.
template <class T>
struct NullSpaceArguments {
  const T* basis;  // (count, length), or one of each sample; null: the constant vector
  int64_t sample;  // entries between two samples; 0: they share it
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

/// Where the tensors and numbers of a Diffusion are. Sides count z, y and x, the low one first.
namespace diffusion_slots {
inline constexpr int kKappa = 0, kShift = 1, kRobin = 2;                        // tensors; kRobin + side
inline constexpr int kShiftNumber = 0, kInverseWidth = 1, kRobinNumber = 4;  // numbers; + axis, + side
}  // namespace diffusion_slots

/// A grid of a hierarchy, with the places of what belongs to it in the numbers of the sample.
struct CoarseGrid {
  int shape[3];          // z, y, x
  int axes;              // bits of those along which it is coarsened; 0: it is the last
  int64_t coefficients;  // of A there
  int64_t weights[3];    // of each such axis: interpolation from before and from after, restriction likewise
  double radius;         // of D⁻¹A, by the rows' sums

  int points() const { return shape[0] * shape[1] * shape[2]; }
  bool is_coarsened(int axis) const { return (axes >> axis & 1) != 0; }
  /// Whether no axis before this one, or behind it, is coarsened.
  bool is_first(int axis) const { return (axes & ((1 << axis) - 1)) == 0; }
  bool is_last(int axis) const { return axes >> (axis + 1) == 0; }
};
/// Each has at most two thirds of the points of the one before.
inline constexpr int kMostGrids = 56;
/// The coarsest one has at most four points an axis.
inline constexpr int kMostOfCoarsest = 64;
/// The grids of one sample.
struct Grids {
  int64_t count;         // 0: A is not finite, or a diagonal is zero on one of them
  int64_t is_symmetric;  // then restriction has the weights of interpolation
  int64_t inverse;       // of A on the last grid: its place in the numbers
  CoarseGrid grid[kMostGrids];
};

template <class T>
struct HierarchyArguments {
  OperatorArguments a;
  Grids* grids;               // (samples,)
  T* numbers;                 // (samples, numbers_of_sample)
  int64_t numbers_of_sample;
  double* work;               // of each team
  unsigned* arrived;          // as those of SolveArguments
  double* parts;
  int64_t samples;
  int64_t nullity;            // how many vectors A is said to map to zero
  const int64_t* nullities;   // of each sample; null: that of all
};

/// A hierarchy as a solve uses it.
template <class T>
struct HierarchyView {
  const Grids* grids;         // null: none
  const T* numbers;
  int64_t numbers_of_sample;  // 0: the samples share both
  int64_t smoothing;          // steps
  int64_t transposed;         // A is the transpose of what it was made of
};

template <class T>
struct SolveArguments {
  OperatorArguments a;
  NullSpaceArguments<T> null_space, left_null_space;
  BatchArrays<T> arrays;
  T* memory;            // vectors that do not fit into a block, and what damping needs, for each team
  unsigned* arrived;    // of each team
  double* parts;        // of the sums of each team
  int64_t batch;
  int64_t needs_projection;  // products leave the range of A by their rounding, and are projected
  HierarchyView<T> hierarchy;
};

/// Numbers of the memory that pseudo_inverse() works in (pseudo_inverse.h), the matrix first.
constexpr int64_t numbers_of_inverse(int64_t n) { return 2 * n * n + 9 * n; }

/// Numbers of a team beyond its vectors: for the damped least squares of GMRES.
constexpr int64_t numbers_beyond(int64_t restart) { return restart * (restart + 3); }

/// Vectors of a sample that the space itself keeps: b, scratch; and with a start, the start and b - A start.
inline constexpr int kOwnVectors = 4;

/// And that a V-cycle keeps of the finest grid.
inline constexpr int kVectorsOfCycle = 3;

/// Blocks of a team keep their parts of so many sums at once.
inline constexpr int kMostAtOnce = 4;

/// Entries of `arrived` per team; and of `parts` per block, for two sums in turn.
inline constexpr int kArrivedOfTeam = 32, kPartsOfBlock = 2 * kMostAtOnce;

}  // namespace prdp::gpu
