#pragma once
#include <cstdint>
#include <string_view>

#include "prdp/kernels/stencil_pattern.h"

/// The inner loops of all kernels. Their one source, loops.cpp, is compiled for several instruction
/// sets, and the best one that the processor has is chosen when they are first used.
namespace prdp::kernels {

/// Values that fill 64 bytes. Vectors are padded with zeros to a multiple of it, so that the compiler
/// may use whole vector registers, and sums run over as many partial sums whatever their width.
template <class T>
inline constexpr int64_t kLanes = 64 / static_cast<int64_t>(sizeof(T));

/// A stencil on one sample in padded rows: `row` values a row, `plane` a plane of `ny` rows. The
/// weights of the neighbours hold a row each for x, y and z, with zeros in the padding so that it stays
/// zero. The centre has one weight; sweeps have none.
template <class T>
struct PaddedStencil {
  int64_t ny, nz, row, plane;
  T centre;
  const T* weights;
};

/// One field on a grid (nz, ny, nx) in padded rows, coupled to its nearest neighbours by coefficients of
/// their own at every point. Each row of the grid has a row of each of them in turn: centre, x lower, x
/// upper (, y lower, y upper (, z lower, z upper)). What leaves a row lies in its `ends`, with zeros in its
/// place: two times kLanes values, which the row's last value multiplies at the row's first kLanes points,
/// and its first value at the last kLanes; null where nothing does. Beyond the first and the last row, and
/// plane, comes the one from the other end, with coefficients of zero where the axis is not periodic.
/// The padding holds zeros but for the centre's, which may be divided by.
template <class T>
struct NeighbourStencil {
  int64_t nz, ny, nx, row;
  const T* coefficients;
  const T* ends;
};

/// The same with neighbours at any offsets, the first being the point itself. What leaves a row has its
/// value in `wrap_values`, as many for each row as there are `wraps`.
template <class T>
struct OffsetStencil {
  int64_t nz, ny, nx, row;
  int64_t count;
  const Offset* offsets;
  const T* coefficients;
  int64_t wrap_count;
  const StencilWrap* wraps;
  const T* wrap_values;
};

/// Offsets of at most two cells in three dimensions.
inline constexpr int64_t kMostOffsets = 125;

/// [[C1, 0, G1], [0, C2, G2], [D1, D2, 0]] on three fields, two velocities and the pressure, with
/// backward differences G and forward differences D. The weights are rows of 1/dx, of 1/dx but for the
/// first point, of 1/dx but for the last point, and of 1/dy; all negative in the transpose.
template <class T>
struct StaggeredStencil {
  NeighbourStencil<T> velocity[2];
  const T* weights;
};

template <class T>
struct Loops {
  const char* level;  // "baseline", "x86-64-v3", "x86-64-v4"

  /// max |x_i|; NaN or Inf if any x_i is not finite; any n.
  T (*largest_magnitude)(const T* x, int64_t n);
  /// to = factor·from for rows of n values, which lie `stride` apart.
  void (*copy_rows)(T factor, const T* from, int64_t from_stride, T* to, int64_t to_stride, int64_t rows, int64_t n);
  /// Σ a_i b_i; any n.
  T (*dot)(const T* a, const T* b, int64_t n);
  /// out = factor·x; out may be x. From here on n is that of padded vectors where not said otherwise.
  void (*scale)(T factor, const T* x, T* out, int64_t n);
  /// y += alpha x; any n.
  void (*axpy)(T alpha, const T* x, T* y, int64_t n);
  /// y = x + beta y
  void (*xpby)(const T* x, T beta, T* y, int64_t n);
  /// x += alpha p and r -= alpha q in one pass; returns ‖r‖². p may be r itself.
  T (*descend)(T alpha, const T* p, const T* q, T* x, T* r, int64_t n);
  /// The same with Σ w_i r_i² besides; y = w∘x + beta y; and Σ w_i x_i². w∘x is entry by entry.
  T (*weighted_descend)(T alpha, const T* p, const T* q, const T* w, T* x, T* r, int64_t n, T* weighted);
  void (*weighted_xpby)(const T* w, const T* x, T beta, T* y, int64_t n);
  T (*weighted_square)(const T* w, const T* x, int64_t n);
  /// For `count` vectors, at least one: h_j = v_j·(factor·w); and w = factor·w + sign·Σ alpha_j v_j, which returns
  /// ‖w‖².
  void (*multi_dot)(const T* const* v, int64_t count, T factor, const T* w, T* h, int64_t n);
  T (*multi_axpy)(T sign, const T* alpha, const T* const* v, int64_t count, T factor, T* w, int64_t n);

  /// By the number of dimensions less one. out = A v; dots = {v·out, ‖out‖²}.
  void (*apply[3])(const PaddedStencil<T>& a, const T* v, T* out, T* dots);
  /// n sweeps x ← c + (neighbours of x, weighted). Returns the one of x and y that holds the result; the
  /// other one is overwritten. With omega, one for each sweep, x ← y + omega (that - y) instead, where y
  /// holds the iterate before x, before and after.
  T* (*sweeps[3])(const PaddedStencil<T>& a, const T* c, T* x, T* y, int64_t n, const T* omega);
  /// One of them, with its result in y; returns ‖c + neighbours - x‖².
  T (*sweep_and_measure[3])(const PaddedStencil<T>& a, const T* c, const T* x, T* y, const T* omega);

  /// Upwind differences and diffusion along one axis: advection (max(w⁻, 0) B + min(w⁺, 0) F) plus
  /// diffusion times minus the second difference, with w⁻ and w⁺ the means of the winds here and on
  /// either side. Sets lower and upper, adds to centre; any n.
  void (*upwind_row)(T advection, T diffusion, const T* before, const T* here, const T* after, T* lower, T* upper,
                     T* centre, int64_t n);
  /// By the number of dimensions less one. out = A v; dots += {v·out, ‖out‖²} unless it is null.
  void (*apply_neighbours[3])(const NeighbourStencil<T>& a, const T* v, T* out, T* dots);
  void (*apply_offsets)(const OffsetStencil<T>& a, const T* v, T* out, T* dots);
  /// A Jacobi sweep y = x + c - D⁻¹A x; *squares += ‖D(y - x)‖² unless it is null.
  void (*sweep_neighbours[3])(const NeighbourStencil<T>& a, const T* c, const T* x, T* y, T* squares);
  void (*sweep_offsets)(const OffsetStencil<T>& a, const T* c, const T* x, T* y, T* squares);
  void (*apply_staggered)(const StaggeredStencil<T>& a, const T* v, T* out);
};

/// The loops for this processor; the environment variable PRDP_CPU_LEVEL asks for a lower level by its
/// name. Raises ValueError for a level that does not exist or that the processor lacks.
template <class T>
const Loops<T>& loops();
template <>
const Loops<float>& loops();
template <>
const Loops<double>& loops();

}  // namespace prdp::kernels
