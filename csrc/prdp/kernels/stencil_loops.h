#pragma once
#include "prdp/kernels/vector_loops.h"

/// The part of loops.cpp for stencils with coefficients of their own at every point; included there only, and all
/// of internal linkage, so that no code for one processor is linked in place of another's.
namespace prdp::kernels {

namespace {

/// Adds the coefficients of upwind differences along one axis to a row; the wind at a face is the mean of its two
/// points. lower and upper belong to this axis, centre is the sum over all axes.
template <class T>
void upwind_row(T advection, T diffusion, const T* before, const T* here, const T* after, T* __restrict lower,
                T* __restrict upper, T* __restrict centre, int64_t n) {
  const T half = advection / 2;
  for (int64_t i = 0; i < n; ++i) {
    const T sum_before = before[i] + here[i], sum_after = here[i] + after[i];
    const T backward = half * (sum_before > T(0) ? sum_before : T(0));
    const T forward = half * (sum_after < T(0) ? sum_after : T(0));
    lower[i] = -backward - diffusion;
    upper[i] = forward - diffusion;
    centre[i] += backward - forward + 2 * diffusion;
  }
}

/// i wrapped into [0, n), for -n <= i < 2n: rows and planes beyond an end come from the other one.
inline int64_t wrapped_index(int64_t i, int64_t n) { return i < 0 ? i + n : i < n ? i : i - n; }

/// Goes along a row register by register, with the ones before and after for the neighbours. What these
/// hold beyond the ends of the row meets weights of zero.
template <class T>
struct Line {
  const T* v;
  Register<T> before = {}, here = {}, after;

  explicit Line(const T* row) : v(row), after(load(row)) {}
  void step_to(int64_t i) {
    before = here;
    here = after;
    after = load(v + i + kWidth<T>);
  }
  Register<T> left() const { return lanes_from<T, kWidth<T> - 1>(before, here); }
  Register<T> right() const { return lanes_from<T, 1>(here, after); }
};

/// Row j of plane z of a field, the rows around it, and its coefficients (NeighbourStencil in loops.h says how they
/// lie). With Differences, a neighbour counts by its difference from the point, and the point itself by its row sum.
template <int Dim, class T, bool Differences = false>
struct NeighbourRow {
  const NeighbourStencil<T>& a;
  int64_t row, last_register;  // its padded length; where its last register starts
  // own: what the point itself is multiplied by; ends: what couples the two ends of a periodic row, null where none do
  const T *w, *own, *ends, *below, *above, *back, *front;
  Line<T> line;

  NeighbourRow(const NeighbourStencil<T>& stencil, int64_t z, int64_t j, const T* field)
      : a(stencil),
        row(a.row),
        last_register((a.nx - 1) / kWidth<T> * kWidth<T>),
        w(a.coefficients + (z * a.ny + j) * (2 * Dim + 1) * row),
        own(Differences ? a.row_sums + (z * a.ny + j) * a.row_sum_step : w),
        ends(a.ends ? a.ends + (z * a.ny + j) * 2 * kLanes<T> : nullptr),
        below(field + (z * a.ny + wrapped_index(j - 1, a.ny)) * row),
        above(field + (z * a.ny + wrapped_index(j + 1, a.ny)) * row),
        back(field + (wrapped_index(z - 1, a.nz) * a.ny + j) * row),
        front(field + (wrapped_index(z + 1, a.nz) * a.ny + j) * row),
        line(field + (z * a.ny + j) * row) {}

  /// A v at register i, but for the ends.
  Register<T> product(int64_t i) {
    line.step_to(i);
    Register<T> sum = load(own + i) * line.here;
    sum += load(w + row + i) * from_here(line.left());
    sum += load(w + 2 * row + i) * from_here(line.right());
    if constexpr (Dim > 1) {
      sum += load(w + 3 * row + i) * from_here(load(below + i));
      sum += load(w + 4 * row + i) * from_here(load(above + i));
    }
    if constexpr (Dim > 2) {
      sum += load(w + 5 * row + i) * from_here(load(back + i));
      sum += load(w + 6 * row + i) * from_here(load(front + i));
    }
    return sum;
  }
  /// Adds what couples the ends of a periodic row: at its first register the last point, at its last register the
  /// first. `ends` has kLanes numbers for either.
  Register<T> with_ends(int64_t i, Register<T> sum) const {
    if (!ends) return sum;
    if (i == 0) sum += load(ends) * from_here(line.v[a.nx - 1]);
    if (i == last_register) sum += load(ends + kLanes<T> + last_register % kLanes<T>) * from_here(line.v[0]);
    return sum;
  }
  /// Of a neighbour, a register or one value, what its coefficient multiplies.
  template <class V>
  auto from_here(const V& there) const {
    if constexpr (Differences) return there - line.here;
    else return there;
  }
};

/// Calls body.finish(i, v, A v, diagonal) for every register i of a field v.
template <int Dim, bool Differences, class T, class Body>
void go_along_rows(const NeighbourStencil<T>& a, Lines lines, const T* v, Body& shared) {
  Body body = shared;  // a copy: the compiler can prove that no store changes it
  for (int64_t line = lines.begin; line < lines.end; ++line) {
    NeighbourRow<Dim, T, Differences> u(a, line / a.ny, line % a.ny, v);
    for (int64_t i = 0, at = line * a.row; i < a.row; i += kWidth<T>) {
      const Register<T> sum = u.product(i);
      body.finish(at + i, u.line.here, u.with_ends(i, sum), u.w + i);
    }
  }
  shared = body;
}
template <int Dim, class T, class Body>
void for_each_register(const NeighbourStencil<T>& a, Lines lines, const T* v, Body& body) {
  if (a.row_sums) go_along_rows<Dim, true>(a, lines, v, body);
  else go_along_rows<Dim, false>(a, lines, v, body);
}

/// Adds to the values of points `begin` to `end` of a row what leaves it and comes back at its other end.
template <class T>
void add_wraps(const OffsetStencil<T>& a, const T* coefficients, const T* const* from, int64_t begin, int64_t end,
               T* values) {
  for (int64_t e = 0; e < a.wrap_count; ++e) {
    const auto& wrap = a.wraps[e];
    if (wrap.to >= begin && wrap.to < end)
      values[wrap.to - begin] += coefficients[e] * from[wrap.coefficient][wrap.from];
  }
}

template <class T, class Body>
void for_each_register(const OffsetStencil<T>& a, Lines lines, const T* v, Body& shared) {
  constexpr int most = 4;  // sums at once, as each waits for its last addition
  Body body = shared;
  const T* from[kMostOffsets];
  for (int64_t line = lines.begin; line < lines.end; ++line) {
    const int64_t at = line * a.row;
    const T* const w = a.coefficients + line * a.count * a.row;
    const T* const wrap_values = a.wrap_values + line * a.wrap_count;
    for (int64_t k = 0; k < a.count; ++k) {
      const auto& o = a.offsets[k].along;
      from[k] =
          v + (wrapped_index(line / a.ny + o[0], a.nz) * a.ny + wrapped_index(line % a.ny + o[1], a.ny)) * a.row + o[2];
    }
    for_each_block<most>(0, a.row / kWidth<T>, [&](int64_t first, auto size) {
      const int64_t begin = first * kWidth<T>, end = begin + size.value * kWidth<T>;
      Register<T> sums[size.value] = {};
      for (int64_t k = 0; k < a.count; ++k)
        for (int c = 0; c < size.value; ++c) {
          const int64_t i = begin + c * kWidth<T>;
          sums[c] += load(w + k * a.row + i) * load(from[k] + i);
        }
      if (a.wrap_count > 0 && (begin < 2 || end > a.nx - 2)) {  // to the first or last two
        T values[size.value * kWidth<T>];
        for (int c = 0; c < size.value; ++c) store(values + c * kWidth<T>, sums[c]);
        add_wraps(a, wrap_values, from, begin, end, values);
        for (int c = 0; c < size.value; ++c) sums[c] = load(values + c * kWidth<T>);
      }
      for (int c = 0; c < size.value; ++c) {
        const int64_t i = begin + c * kWidth<T>;
        body.finish(at + i, load(v + at + i), sums[c], w + i);
      }
    });
  }
  shared = body;
}

/// out = A v and, if Dots, the parts of v·out and ‖out‖².
template <bool Dots, class T>
struct StencilProduct {
  T* out;
  Register<T> v_out = {}, out_out = {};

  void finish(int64_t i, const Register<T>& v, const Register<T>& av, const T*) {
    store(out + i, av);
    if constexpr (!Dots) return;
    v_out += v * av;
    out_out += av * av;
  }
};

/// y = x + c - D⁻¹A x and, if Measure, the parts of ‖D(y - x)‖².
template <bool Measure, class T>
struct StencilSweep {
  const T* c;
  T* y;
  Register<T> squares = {};

  void finish(int64_t i, const Register<T>& x, const Register<T>& ax, const T* diagonal) {
    const Register<T> d = load(diagonal), change = load(c + i) - ax / d;
    store<T>(y + i, x + change);
    if constexpr (!Measure) return;
    const Register<T> r = d * change;
    squares += r * r;
  }
};

/// y = x + p (x - y) + q D⁻¹(b - A x)
template <class T>
struct StencilSmoothing {
  const T* b;
  T* y;
  T p, q;

  void finish(int64_t i, const Register<T>& x, const Register<T>& ax, const T* diagonal) {
    const Register<T> before = load(y + i);
    store<T>(y + i, x + p * (x - before) + q * (load(b + i) - ax) / load(diagonal));
  }
};

/// r = b - A x
template <class T>
struct StencilResidual {
  const T* b;
  T* r;

  void finish(int64_t i, const Register<T>&, const Register<T>& ax, const T*) { store<T>(r + i, load(b + i) - ax); }
};

template <class Traversal, class T>
void stencil_product(const Traversal& for_each, T* out, T* dots) {
  if (!dots) {
    StencilProduct<false, T> body{out};
    return for_each(body);
  }
  StencilProduct<true, T> body{out};
  for_each(body);
  dots[0] += sum_lanes<T>(body.v_out);
  dots[1] += sum_lanes<T>(body.out_out);
}
template <class Traversal, class T>
void stencil_sweep(const Traversal& for_each, const T* c, T* y, T* squares) {
  if (!squares) {
    StencilSweep<false, T> body{c, y};
    return for_each(body);
  }
  StencilSweep<true, T> body{c, y};
  for_each(body);
  *squares += sum_lanes<T>(body.squares);
}

template <int Dim, class T>
void apply_neighbours(const NeighbourStencil<T>& a, Lines lines, const T* v, T* out, T* dots) {
  stencil_product([&](auto& body) { for_each_register<Dim>(a, lines, v, body); }, out, dots);
}
template <class T>
void apply_offsets(const OffsetStencil<T>& a, Lines lines, const T* v, T* out, T* dots) {
  stencil_product([&](auto& body) { for_each_register(a, lines, v, body); }, out, dots);
}
template <int Dim, class T>
void sweep_neighbours(const NeighbourStencil<T>& a, Lines lines, const T* c, const T* x, T* y, T* squares) {
  stencil_sweep([&](auto& body) { for_each_register<Dim>(a, lines, x, body); }, c, y, squares);
}
template <class T>
void sweep_offsets(const OffsetStencil<T>& a, Lines lines, const T* c, const T* x, T* y, T* squares) {
  stencil_sweep([&](auto& body) { for_each_register(a, lines, x, body); }, c, y, squares);
}

template <int Dim, class T>
void smooth_neighbours(const NeighbourStencil<T>& a, Lines lines, const T* b, const T* x, T* y, T p, T q) {
  StencilSmoothing<T> body{b, y, p, q};
  for_each_register<Dim>(a, lines, x, body);
}
template <class T>
void smooth_offsets(const OffsetStencil<T>& a, Lines lines, const T* b, const T* x, T* y, T p, T q) {
  StencilSmoothing<T> body{b, y, p, q};
  for_each_register(a, lines, x, body);
}

template <int Dim, class T>
void residual_neighbours(const NeighbourStencil<T>& a, Lines lines, const T* b, const T* x, T* r) {
  StencilResidual<T> body{b, r};
  for_each_register<Dim>(a, lines, x, body);
}
template <class T>
void residual_offsets(const OffsetStencil<T>& a, Lines lines, const T* b, const T* x, T* r) {
  StencilResidual<T> body{b, r};
  for_each_register(a, lines, x, body);
}

/// out = A v on these rows of the three fields. What couples the pressure and the divergence across the ends of a
/// periodic row is added last.
template <class T>
void apply_staggered(const StaggeredStencil<T>& a, Lines lines, const T* v, T* out) {
  const auto& grid = a.velocity[0];
  const int64_t row = grid.row, field = grid.ny * row, last = grid.nx - 1;
  const T *inverse_dx = a.weights, *inverse_dx_lower = inverse_dx + row, *inverse_dx_upper = inverse_dx + 2 * row,
          *inverse_dy = inverse_dx + 3 * row;
  out += lines.begin * row;
  T *out1 = out, *out2 = out + field, *divergence = out + 2 * field;
  for (int64_t j = lines.begin; j < lines.end; ++j, out1 += row, out2 += row, divergence += row) {
    NeighbourRow<2, T> u1(a.velocity[0], 0, j, v), u2(a.velocity[1], 0, j, v + field);
    Line<T> p(v + 2 * field + j * row);
    const T* p_below = v + 2 * field + wrapped_index(j - 1, grid.ny) * row;
    for (int64_t i = 0; i < row; i += kWidth<T>) {
      p.step_to(i);
      Register<T> c1 = u1.product(i), c2 = u2.product(i);
      c1 = c1 + load(inverse_dx + i) * p.here - load(inverse_dx_lower + i) * p.left();
      c2 = c2 + load(inverse_dy + i) * (p.here - load(p_below + i));
      store<T>(out1 + i, u1.with_ends(i, c1));
      store<T>(out2 + i, u2.with_ends(i, c2));
      store<T>(divergence + i, load(inverse_dx_upper + i) * u1.line.right() - load(inverse_dx + i) * u1.line.here +
                                   load(inverse_dy + i) * (load(u2.above + i) - u2.line.here));
    }
    out1[0] -= inverse_dx[0] * p.v[last];
    divergence[last] += inverse_dx[0] * u1.line.v[0];
  }
}

}  // namespace

}  // namespace prdp::kernels
