#pragma once
#include "prdp/kernels/vector_loops.h"

/// The part of loops.cpp for the Laplacian-type stencil on padded rows; included there only.
namespace prdp::kernels {

namespace {

/// Registers of a row that are kept while going down a plane.
constexpr int kColumns = 4;

/// A plane with the two next to it; those are read in three dimensions only.
template <class T>
struct Planes {
  const T *below, *here, *above;
};

/// Goes down Columns registers of a plane from offset i, with the row here and the one before it in
/// registers. For each register v, body.start(i, v) is what the weighted sum of the 2·Dim neighbours of
/// v is added to, and body.finish(i, k, v, sum) takes it; it may overwrite v where this is the WholeRow.
template <int Dim, int Columns, bool WholeRow, class T, class Body>
void go_down(const ConstantStencil<T>& a, const Planes<T>& plane, int64_t i, Body& shared) {
  using V = Register<T>;
  constexpr int width = kWidth<T>;
  // Copies, which no store can change for all the compiler knows.
  const T *x = plane.here, *below = plane.below, *above = plane.above;
  const int64_t row = a.row, end = i + a.ny * row;
  Body body = shared;
  V weight[Dim][Columns], before[Columns], here[Columns], after[Columns];
  for (int k = 0; k < Columns; ++k) {
    for (int d = 0; d < Dim; ++d) weight[d][k] = load(a.weights + d * row + i + k * width);
    here[k] = load(x + i + k * width);
    if constexpr (Dim > 1) before[k] = load(x + i + k * width - row);
  }
  for (; i < end; i += row) {
    V left = {}, right = {};
    if constexpr (!WholeRow) {
      left = load(x + i - width);
      right = load(x + i + Columns * width);
    }
#pragma GCC unroll 4
    for (int k = 0; k < Columns; ++k) {
      const int64_t at = i + k * width;
      V sum = body.start(at, here[k]);
      sum += weight[0][k] * (lanes_from<T, width - 1>(k > 0 ? here[k - 1] : left, here[k]) +
                             lanes_from<T, 1>(here[k], k + 1 < Columns ? here[k + 1] : right));
      if constexpr (Dim > 1) {
        after[k] = load(x + at + row);
        sum += weight[1][k] * (before[k] + after[k]);
      }
      if constexpr (Dim > 2) sum += weight[2][k] * (load(below + at) + load(above + at));
      body.finish(at, k, here[k], sum);
    }
    if constexpr (Dim > 1)
      for (int k = 0; k < Columns; ++k) before[k] = here[k], here[k] = after[k];
  }
  shared = body;
}

template <int Dim, class T, class Body>
void go_through(const ConstantStencil<T>& a, const Planes<T>& plane, Body& body) {
  const int64_t registers = a.row / kWidth<T>;
  for_each_block<kColumns>(0, registers, [&](int64_t first, auto columns) {
    if (columns.value == registers) go_down<Dim, columns.value, true>(a, plane, 0, body);
    else go_down<Dim, columns.value, false>(a, plane, first * kWidth<T>, body);
  });
}

/// out = A v and the parts of v·out and ‖out‖².
template <class T>
struct Product {
  T centre;
  T* out;
  Register<T> v_out[2] = {}, out_out[2] = {};

  Register<T> start(int64_t, const Register<T>& v) const { return centre * v; }
  void finish(int64_t i, int k, const Register<T>& v, const Register<T>& av) {
    v_out[k % 2] += v * av;
    out_out[k % 2] += av * av;
    store(out + i, av);
  }
};

template <int Dim, class T>
void apply(const ConstantStencil<T>& a, const T* v, T* out, T* dots) {
  Product<T> body{a.centre, out};
  for (int64_t z = 0; z < a.nz; ++z, v += a.plane, body.out += a.plane)
    go_through<Dim>(a, {v - a.plane, v, v + a.plane}, body);
  dots[0] = sum_lanes<T>(body.v_out[0] + body.v_out[1]);
  dots[1] = sum_lanes<T>(body.out_out[0] + body.out_out[1]);
}

/// A sweep y = c + neighbours of x, or y += omega (c + neighbours of x - y); with Measure, also the
/// parts of ‖c + neighbours of x - x‖².
template <bool Accelerated, bool Measure, class T>
struct Sweep {
  const T* c;
  T* y;
  T omega;
  Register<T> squares[2] = {};

  Register<T> start(int64_t i, const Register<T>&) const { return load(c + i); }
  void finish(int64_t i, int k, const Register<T>& x, const Register<T>& next) {
    if constexpr (Measure) {
      const Register<T> change = next - x;
      squares[k % 2] += change * change;
    }
    if constexpr (Accelerated) {
      const auto y_i = load(y + i);
      store<T>(y + i, y_i + omega * (next - y_i));
    } else {
      store(y + i, next);
    }
  }
};

template <int Dim, class T, class Body>
void one_sweep(const ConstantStencil<T>& a, const T* x, Body& body) {
  for (int64_t z = 0; z < a.nz; ++z, x += a.plane, body.c += a.plane, body.y += a.plane)
    go_through<Dim>(a, {x - a.plane, x, x + a.plane}, body);
}

template <int Dim, bool Accelerated, class T>
T measured_sweep(const ConstantStencil<T>& a, const T* c, const T* x, T* y, T omega) {
  Sweep<Accelerated, true, T> body{c, y, omega};
  one_sweep<Dim>(a, x, body);
  return sum_lanes<T>(body.squares[0] + body.squares[1]);
}

/// All sweeps of a short line without memory in between; the result is in x.
template <int Columns, bool Accelerated, class T>
void sweeps_in_registers(const ConstantStencil<T>& a, const T* c, T* x, T* y, int64_t n, const T* omega) {
  using V = Register<T>;
  V weight[Columns], source[Columns], here[Columns], before[Columns];
  for (int k = 0; k < Columns; ++k) {
    weight[k] = load(a.weights + k * kWidth<T>);
    source[k] = load(c + k * kWidth<T>);
    here[k] = load(x + k * kWidth<T>);
    before[k] = load(y + k * kWidth<T>);
  }
  const V none = {};
  for (int64_t s = 0; s < n; ++s) {
    V next[Columns];
    for (int k = 0; k < Columns; ++k) {
      next[k] = source[k];
      next[k] += weight[k] * (lanes_from<T, kWidth<T> - 1>(k > 0 ? here[k - 1] : none, here[k]) +
                              lanes_from<T, 1>(here[k], k + 1 < Columns ? here[k + 1] : none));
      if constexpr (Accelerated) next[k] = before[k] + omega[s] * (next[k] - before[k]);
    }
    for (int k = 0; k < Columns; ++k) before[k] = here[k], here[k] = next[k];
  }
  for (int k = 0; k < Columns; ++k) {
    store(x + k * kWidth<T>, here[k]);
    store(y + k * kWidth<T>, before[k]);
  }
}

/// Two sweeps in one pass over memory, x → y → x, the second a plane behind the first.
template <bool Accelerated, class T>
void two_sweeps(const ConstantStencil<T>& a, const T* c, T* x, T* y, const T* omega) {
  const auto sweep = [&](const T* from, T* to, int64_t z, int s) {
    from += z * a.plane;
    Sweep<Accelerated, false, T> body{c + z * a.plane, to + z * a.plane, Accelerated ? omega[s] : T(1)};
    go_through<3>(a, {from - a.plane, from, from + a.plane}, body);
  };
  for (int64_t z = 0; z <= a.nz; ++z) {
    if (z < a.nz) sweep(x, y, z, 0);
    if (z > 0) sweep(y, x, z - 1, 1);
  }
}

template <int Dim, bool Accelerated, class T>
T* many_sweeps(const ConstantStencil<T>& a, const T* c, T* x, T* y, int64_t n, const T* omega) {
  const int64_t registers = a.row / kWidth<T>;
  if constexpr (Dim == 1) {
    if (registers <= kColumns) {
      for_each_block<kColumns>(0, registers, [&](int64_t, auto columns) {
        sweeps_in_registers<columns.value, Accelerated>(a, c, x, y, n, omega);
      });
      return x;
    }
  }
  int64_t s = 0;
  if constexpr (Dim == 3)
    for (; s + 2 <= n; s += 2) two_sweeps<Accelerated>(a, c, x, y, Accelerated ? omega + s : nullptr);
  // A plane that goes through registers row by row may be overwritten on the way.
  const bool in_place = Dim == 2 && !Accelerated && registers <= kColumns;
  for (; s < n; ++s) {
    Sweep<Accelerated, false, T> body{c, in_place ? x : y, Accelerated ? omega[s] : T(1)};
    one_sweep<Dim>(a, x, body);
    if (in_place) continue;
    T* const swap = x;
    x = y;
    y = swap;
  }
  return x;
}

/// y = x + p (x - y) + q D⁻¹(b - A x)
template <class T>
struct Smoothing {
  const T* b;
  T* y;
  T p, q, centre;

  Register<T> start(int64_t, const Register<T>& x) const { return centre * x; }
  void finish(int64_t i, int, const Register<T>& x, const Register<T>& ax) {
    store<T>(y + i, x + p * (x - load(y + i)) + q * (load(b + i) - ax));
  }
};

template <int Dim, class T>
void smooth(const ConstantStencil<T>& a, const T* b, const T* x, T* y, T p, T q, T inverse_diagonal) {
  Smoothing<T> body{b, y, p, q * inverse_diagonal, a.centre};
  for (int64_t z = 0; z < a.nz; ++z, x += a.plane, body.b += a.plane, body.y += a.plane)
    go_through<Dim>(a, {x - a.plane, x, x + a.plane}, body);
}

/// r = b - A x
template <class T>
struct Residual {
  const T* b;
  T *y, centre;

  Register<T> start(int64_t, const Register<T>& x) const { return centre * x; }
  void finish(int64_t i, int, const Register<T>&, const Register<T>& ax) { store<T>(y + i, load(b + i) - ax); }
};

template <int Dim, class T>
void residual(const ConstantStencil<T>& a, const T* b, const T* x, T* r) {
  Residual<T> body{b, r, a.centre};
  for (int64_t z = 0; z < a.nz; ++z, x += a.plane, body.b += a.plane, body.y += a.plane)
    go_through<Dim>(a, {x - a.plane, x, x + a.plane}, body);
}

template <int Dim, class T>
T* sweeps(const ConstantStencil<T>& a, const T* c, T* x, T* y, int64_t n, const T* omega) {
  return omega ? many_sweeps<Dim, true>(a, c, x, y, n, omega) : many_sweeps<Dim, false>(a, c, x, y, n, omega);
}
template <int Dim, class T>
T sweep_and_measure(const ConstantStencil<T>& a, const T* c, const T* x, T* y, const T* omega) {
  return omega ? measured_sweep<Dim, true>(a, c, x, y, *omega) : measured_sweep<Dim, false>(a, c, x, y, T(1));
}

}  // namespace

}  // namespace prdp::kernels
