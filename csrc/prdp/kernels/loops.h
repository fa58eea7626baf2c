#pragma once
#include <cstdint>

#include "prdp/kernels/stencil_sparsity.h"

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
struct ConstantStencil {
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
///
/// With `row_sums`, products are made of differences: A v is row_sums∘v and, for each neighbour, its coefficient times
/// how far it is from the point itself. The centre, which is the sum of them all, is then for divisions alone.
/// `row_sums` has a row for each row of the grid, `row_sum_step` apart.
template <class T>
struct NeighbourStencil {
  int64_t nz, ny, nx, row;
  const T* coefficients;
  const T* ends;
  const T* row_sums = nullptr;
  int64_t row_sum_step = 0;
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

/// The coefficients of a coarse operator at a row of coarse points, Galerkin's product with the fine one along one
/// axis. "Before" and "after" are the fine points on either side of a coarse one, "here". Fine coefficients with one
/// offset in the other axes: lower, centre and upper along this one, null where there is none but the centre. The
/// weights by which a fine point is interpolated from the coarse points to its left and right belong to the column,
/// those of the restriction to the row.
template <class T>
struct GalerkinProduct {
  const T *lower_before, *lower_here, *lower_after;
  const T *centre_before, *centre_here, *centre_after;
  const T *upper_before, *upper_here, *upper_after;
  const T *before_left, *before_right, *after_left, *after_right;
  const T *restrict_before, *restrict_after;
  T *left, *centre, *right;  // out
};

/// out (rows, columns) = a (rows, inner) times b (inner, columns), all contiguous row by row.
template <class T>
struct DenseProduct {
  const T *a, *b;
  T* out;
  int64_t rows, inner, columns;
};

/// Advection and diffusion of a component c of a velocity along an axis, whose own component is w, on a staggered grid:
/// ν ∂²c - (w ∂)c. Neighbours lie `step` apart along the axis, and `own_step` along the axis of c.
template <class T>
struct AdvectionTerm {
  bool own;  // w is c
  bool upwind;
  int64_t own_step, step;
  T quarter_dx, diffusion;  // 1/(4 dx), ν/dx²
};

/// Rows of a field from `begin` to `end`, counted over all planes.
struct Lines {
  int64_t begin, end;
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
  /// The same in one pass with dots = {w·out, ‖out‖²}.
  void (*scale_with_dots)(T factor, const T* x, const T* w, T* out, T* dots, int64_t n);
  /// y += alpha x; any n.
  void (*axpy)(T alpha, const T* x, T* y, int64_t n);
  /// out += c∘v, entry by entry; any n.
  void (*add_product)(const T* c, const T* v, T* out, int64_t n);
  /// y = x + beta y; and the same, returning ‖y‖².
  void (*xpby)(const T* x, T beta, T* y, int64_t n);
  T (*xpby_with_square)(const T* x, T beta, T* y, int64_t n);
  /// x += alpha p and r -= alpha q in one pass; returns ‖r‖². p may be r itself.
  T (*update_iterate_and_residual)(T alpha, const T* p, const T* q, T* x, T* r, int64_t n);
  /// out = w∘x, entry by entry; returns x·out.
  T (*weigh)(const T* w, const T* x, T* out, int64_t n);
  /// For `count` vectors, at least one: h_j = v_j·(factor·w); and w = factor·w + sign·Σ alpha_j v_j, which returns
  /// ‖w‖².
  void (*multi_dot)(const T* const* v, int64_t count, T factor, const T* w, T* h, int64_t n);
  T (*multi_axpy)(T sign, const T* alpha, const T* const* v, int64_t count, T factor, T* w, int64_t n);

  /// By the number of dimensions less one. out = A v; dots = {v·out, ‖out‖²}.
  void (*apply[3])(const ConstantStencil<T>& a, const T* v, T* out, T* dots);
  /// n sweeps x ← c + (neighbours of x, weighted). Returns the one of x and y that holds the result; the
  /// other one is overwritten. With omega, one for each sweep, x ← y + omega (that - y) instead, where y
  /// holds the iterate before x, on entry and on return.
  T* (*sweeps[3])(const ConstantStencil<T>& a, const T* c, T* x, T* y, int64_t n, const T* omega);
  /// One of them, with its result in y; returns ‖c + neighbours - x‖².
  T (*sweep_and_measure[3])(const ConstantStencil<T>& a, const T* c, const T* x, T* y, const T* omega);

  /// Upwind differences and diffusion along one axis: advection (max(w⁻, 0) B + min(w⁺, 0) F) plus
  /// diffusion times minus the second difference, with w⁻ and w⁺ the means of the winds here and on
  /// either side. Sets lower and upper, adds to centre; any n.
  void (*upwind_row)(T advection, T diffusion, const T* before, const T* here, const T* after, T* lower, T* upper,
                     T* centre, int64_t n);
  /// On the rows that `lines` names, by the number of dimensions less one: out = A v, and dots += {v·out, ‖out‖²}
  /// unless that is null.
  void (*apply_neighbours[3])(const NeighbourStencil<T>& a, Lines lines, const T* v, T* out, T* dots);
  void (*apply_offsets)(const OffsetStencil<T>& a, Lines lines, const T* v, T* out, T* dots);
  /// A Jacobi sweep y = x + c - D⁻¹A x; *squares += ‖D(y - x)‖² unless it is null.
  void (*sweep_neighbours[3])(const NeighbourStencil<T>& a, Lines lines, const T* c, const T* x, T* y, T* squares);
  void (*sweep_offsets)(const OffsetStencil<T>& a, Lines lines, const T* c, const T* x, T* y, T* squares);
  void (*apply_staggered)(const StaggeredStencil<T>& a, Lines lines, const T* v, T* out);

  /// A smoothing step y = x + p (x - y) + q D⁻¹(b - A x): on entry y is the iterate before x, on return the one after
  /// it. On Laplacians the same with 1/D for the last argument.
  void (*smooth_neighbours[3])(const NeighbourStencil<T>& a, Lines lines, const T* b, const T* x, T* y, T p, T q);
  void (*smooth_offsets)(const OffsetStencil<T>& a, Lines lines, const T* b, const T* x, T* y, T p, T q);
  void (*smooth[3])(const ConstantStencil<T>& a, const T* b, const T* x, T* y, T p, T q, T inverse_diagonal);
  /// r = b - A x
  void (*residual_neighbours[3])(const NeighbourStencil<T>& a, Lines lines, const T* b, const T* x, T* r);
  void (*residual_offsets)(const OffsetStencil<T>& a, Lines lines, const T* b, const T* x, T* r);
  void (*residual[3])(const ConstantStencil<T>& a, const T* b, const T* x, T* r);
  /// out = middle + weight_before∘before + weight_after∘after; and out += the last two; any n.
  void (*restrict_row)(const T* middle, const T* before, const T* weight_before, const T* after, const T* weight_after,
                       T* out, int64_t n);
  void (*add_interpolated)(const T* before, const T* weight_before, const T* after, const T* weight_after, T* out,
                           int64_t n);
  /// Every second value of a row of n, from its first and from its second one on; and row += the two.
  void (*split)(const T* row, T* first, T* second, int64_t n);
  void (*add_merged)(const T* first, const T* second, T* row, int64_t n);
  /// For n coarse points, whose fine ones lie one or two values apart.
  void (*galerkin_product)(const GalerkinProduct<T>& c, int64_t step, int64_t n);

  void (*multiply)(const DenseProduct<T>& p);
  /// out += Σ weights_i row_i, in their order, for `count` rows of n that lie `stride` apart; any n.
  void (*add_rows)(const T* weights, const T* rows, int64_t stride, int64_t count, T* out, int64_t n);
  /// P A = L U with partial pivoting, in the place of A, whose n columns begin `stride` apart. L has ones on its
  /// diagonal. Row i of P A is row rows[i] of A.
  void (*factor_lu)(double* a, int64_t stride, int64_t n, int64_t* rows);
  /// x ← U⁻¹ L⁻¹ x, or L⁻ᵀ U⁻ᵀ x, of 1, 2, 4 or 8 vectors (the power of two is the index) whose entries lie side by
  /// side: each has the bits that it has alone.
  void (*solve_lu[4])(const double* lu, int64_t stride, int64_t n, double* x, bool transposed);

  /// out += the term, for a row of any n.
  void (*advect_row)(const AdvectionTerm<T>& t, const T* c, const T* w, T* out, int64_t n);
  /// From the cotangents g of a row: those of what each point reads, a row of n each: c before, here and after; twice
  /// the velocity through the low and the high edge. Adds g (c before - 2 c here + c after) to a sixth row.
  void (*advect_row_back)(const AdvectionTerm<T>& t, const T* c, const T* w, const T* g, T* bars, int64_t n);
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
