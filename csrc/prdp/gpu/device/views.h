#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/gpu/device/arguments.h"
#include "prdp/gpu/device/largest.h"
#include "prdp/kernels/scales.h"

/// Operators as a kernel knows them: what stands in a row of A. The sizes are constants. `v` is anything with v[i].
/// `Cycled` is what coarse grids are made of, where multigrid serves the operator.
/// What a view computes with is factor·A, where the factor is a power of two that makes the entries of order one.
namespace prdp::gpu {

/// A grid of nz planes of ny rows of nx points, and one of these points.
template <int nz, int ny, int nx>
struct Grid {
  static constexpr int kPoints = nz * ny * nx;
  static constexpr int kX = nx, kY = ny, kZ = nz;
  int x, y, z;
  explicit Grid(int point) : x(point % nx), y(point / nx % ny), z(point / (nx * ny)) {}
  int point() const { return (z * ny + y) * nx + x; }
};

/// A neighbour, so many cells away along each axis.
template <int dz, int dy, int dx>
struct Offset {
  static constexpr int kZ = dz, kY = dy, kX = dx;
};

/// The index after `cells` more along an axis of n; -1 beyond the end of one that is not periodic.
template <int n, int cells, bool periodic>
inline int moved(int index) {
  if constexpr (cells == 0) return index;
  if constexpr (periodic) {
    constexpr int forward = (cells % n + n) % n;
    const int next = index + forward;
    return next < n ? next : next - n;
  } else {
    const int next = index + cells;
    return next >= 0 && next < n ? next : -1;
  }
}

/// Brings A to the order of one; false where it is not finite.
template <class T, class Team, class A>
bool scale_operator(Team& team, A& a) {
  if constexpr (A::kIsScaled) {
    return std::isfinite(a.norm_of_row(0));
  } else {
    const T most = largest_of(team, A::kUnknowns, [&](int i) { return a.largest_in_row(i); });
    if (!std::isfinite(most)) return false;
    a.scale(kernels::scale_of_operator(most));
    return true;
  }
}

/// f(a, dz, dy, dx) for a point that is coupled to its nearest neighbours, the same on both sides of an axis.
template <class T, class F>
void for_each_nearest(T centre, T z, T y, T x, const F& f) {
  f(centre, 0, 0, 0);
  for (int side = -1; side <= 1; side += 2) {
    f(x, 0, 0, side);
    f(y, 0, side, 0);
    f(z, side, 0, 0);
  }
}

/// α I + β L with the Laplacian L of a box, zero outside the grid. Numbers: α, β, and 1/h² along z, y and x. Tensor,
/// where it is there: a number that β is multiplied by, (batch or 1, 1).
template <class T, class G>
class Laplacian {
 public:
  static constexpr int kUnknowns = G::kPoints;
  static constexpr bool kKnowsRadius = true;
  static constexpr bool kIsScaled = true;

  Laplacian(const OperatorArguments& a, int64_t sample) {
    const T* const by = a.tensors[0] ? static_cast<const T*>(a.tensors[0]) + sample * a.sample_strides[0] : nullptr;
    const double beta = by ? a.numbers[1] * static_cast<double>(*by) : a.numbers[1];
    constexpr int kExtents[3] = {G::kZ, G::kY, G::kX};
    constexpr double kPi = 3.141592653589793;
    double centre = a.numbers[0], off[3] = {0, 0, 0}, around = 0;
    for (int axis = 0; axis < 3; ++axis) {
      off[axis] = beta * a.numbers[2 + axis];
      centre -= 2 * off[axis];
      around += 2 * std::abs(off[axis]) * std::cos(kPi / (kExtents[axis] + 1));
      norm_ += 2 * std::abs(off[axis]);
    }
    const double factor = kernels::scale_of_operator(std::abs(centre));
    factor_ = static_cast<T>(factor);
    centre_ = static_cast<T>(centre * factor);
    z_ = static_cast<T>(off[0] * factor);
    y_ = static_cast<T>(off[1] * factor);
    x_ = static_cast<T>(off[2] * factor);
    norm_ = (norm_ + std::abs(centre)) * factor;
    if (by && !(*by >= T(0))) norm_ = std::numeric_limits<double>::quiet_NaN();  // ν is not allowed
    radius_ = around / std::abs(centre);
  }

  using Cycled = Laplacian;
  using Points = G;
  static constexpr bool periodic(int) { return false; }
  /// f(a, dz, dy, dx) for what couples a point to its neighbours, in the grid or out of it: what multigrid is made of.
  /// Scaled only where the view always is.
  template <class F>
  void for_each_offset(int, const F& f) const {
    for_each_nearest(centre_, z_, y_, x_, f);
  }
  T factor() const { return factor_; }
  double norm_of_row(int) const { return norm_; }
  double radius() const { return radius_; }
  T diagonal(int) const { return centre_; }
  template <class V>
  T product(const V& v, int i) const {
    const G at(i);
    T sum = centre_ * v[i];
    if constexpr (G::kX > 1) sum += x_ * ((at.x > 0 ? v[i - 1] : T(0)) + (at.x + 1 < G::kX ? v[i + 1] : T(0)));
    if constexpr (G::kY > 1) sum += y_ * ((at.y > 0 ? v[i - G::kX] : T(0)) + (at.y + 1 < G::kY ? v[i + G::kX] : T(0)));
    if constexpr (G::kZ > 1)
      sum += z_ * ((at.z > 0 ? v[i - G::kX * G::kY] : T(0)) + (at.z + 1 < G::kZ ? v[i + G::kX * G::kY] : T(0)));
    return sum;
  }

 private:
  T factor_, centre_, z_, y_, x_;
  double norm_ = 0, radius_;
};

/// An operator that says which entries stand in a row: for_each_entry(i, f) calls f(a_ij, j), where several may have
/// the same j.
template <class View, class T>
class OperatorRows {
 public:
  static constexpr bool kKnowsRadius = false;
  static constexpr bool kIsScaled = false;

  T largest_in_row(int i) const {
    T most = 0;
    view().for_each_entry(i, [&](T a, int) { most = larger_or_nan(most, std::abs(a)); });
    return most;
  }
  void scale(T factor) { factor_ = factor; }
  T factor() const { return factor_; }
  double norm_of_row(int i) const {
    double sum = 0;
    view().for_each_entry(i, [&](T a, int) { sum += static_cast<double>(std::abs(factor_ * a)); });
    return sum;
  }
  double radius() const { return 0; }
  T diagonal(int i) const {
    T sum = 0;
    view().for_each_entry(i, [&](T a, int j) { sum += j == i ? factor_ * a : T(0); });
    return sum;
  }
  template <class V>
  T product(const V& v, int i) const {
    T sum = 0;
    view().for_each_entry(i, [&](T a, int j) { sum += (factor_ * a) * v[j]; });
    return sum;
  }

 private:
  const View& view() const { return static_cast<const View&>(*this); }

  T factor_ = 1;
};

/// Tensors: coefficients, one field for each offset, which all channels share. (A v)[i] = Σ_k c_k[i] v[i + offset_k],
/// or (Aᵀ v)[i] = Σ_k c_k[i - offset_k] v[i - offset_k].
template <class T, class G, int kChannels, bool kTransposed, bool periodic_z, bool periodic_y, bool periodic_x,
          class... Offsets>
class Stencil
    : public OperatorRows<Stencil<T, G, kChannels, kTransposed, periodic_z, periodic_y, periodic_x, Offsets...>, T> {
 public:
  static constexpr int kUnknowns = kChannels * G::kPoints;

  Stencil(const OperatorArguments& a, int64_t sample)
      : coefficients_(static_cast<const T*>(a.tensors[0]) + sample * a.sample_strides[0]) {}

  using Cycled = Stencil;
  using Points = G;
  static constexpr bool periodic(int axis) { return axis == 0 ? periodic_z : axis == 1 ? periodic_y : periodic_x; }
  /// What leads out of the grid is known of A, not of Aᵀ.
  template <class F>
  void for_each_offset(int point, const F& f) const {
    const auto one = [&]<class O>(O, T a) {
      constexpr int sign = kTransposed ? -1 : 1;
      f(a, sign * O::kZ, sign * O::kY, sign * O::kX);
    };
    int k = 0;
    if constexpr (kTransposed) {
      const G at(point);
      (entry<Offsets>(at, point, 0, k++, [&](T a, int) { one(Offsets(), a); }), ...);
    } else {
      (one(Offsets(), coefficients_[kOfOffset * k++ + point]), ...);
    }
  }
  /// Of all that stands there, also of what leads out of the grid.
  T largest_in_row(int i) const {
    T most = 0;
    for (int k = 0; k < static_cast<int>(sizeof...(Offsets)); ++k)
      most = larger_or_nan(most, std::abs(coefficients_[kOfOffset * k + i % G::kPoints]));
    return most;
  }
  /// Of the neighbours that are inside the grid.
  template <class F>
  void for_each_entry(int i, const F& f) const {
    const int point = i % G::kPoints;
    const G at(point);
    int k = 0;
    (entry<Offsets>(at, point, i - point, k++, f), ...);
  }

 private:
  static constexpr int64_t kOfOffset = G::kPoints;  // coefficients; those of all offsets may be more than an int counts

  template <class O, class F>
  void entry(const G& at, int point, int channel, int k, const F& f) const {
    constexpr int sign = kTransposed ? -1 : 1;
    const int z = moved<G::kZ, sign * O::kZ, periodic_z>(at.z);
    const int y = moved<G::kY, sign * O::kY, periodic_y>(at.y);
    const int x = moved<G::kX, sign * O::kX, periodic_x>(at.x);
    if ((z | y | x) < 0) return;
    const int there = (z * G::kY + y) * G::kX + x;
    f(coefficients_[kOfOffset * k + (kTransposed ? there : point)], channel + there);
  }

  const T* coefficients_;
};

/// Tensors: A, n rows of n entries.
template <class T, int n, bool kTransposed>
class Dense : public OperatorRows<Dense<T, n, kTransposed>, T> {
 public:
  static constexpr bool kLoadsEnough = true;
  static constexpr int kUnknowns = n;

  Dense(const OperatorArguments& a, int64_t sample)
      : matrix_(static_cast<const T*>(a.tensors[0]) + sample * a.sample_strides[0]) {}

  template <class F>
  void for_each_entry(int i, const F& f) const {
    constexpr int64_t row = n;  // n² may be more than an int holds
    for (int j = 0; j < n; ++j) f(kTransposed ? matrix_[j * row + i] : matrix_[i * row + j], j);
  }

 private:
  const T* matrix_;
};

/// Tensors: the ends of the rows, n + 1 from 0 on; columns; values. Number: how many values are stored.
template <class T, int n>
class Csr : public OperatorRows<Csr<T, n>, T> {
 public:
  static constexpr bool kLoadsEnough = true;
  static constexpr int kUnknowns = n;

  Csr(const OperatorArguments& a, int64_t sample)
      : crow_(static_cast<const int64_t*>(a.tensors[0]) + sample * a.sample_strides[0]),
        col_(static_cast<const int64_t*>(a.tensors[1]) + sample * a.sample_strides[1]),
        values_(static_cast<const T*>(a.tensors[2]) + sample * a.sample_strides[2]),
        stored_(static_cast<int64_t>(a.numbers[0])) {}

  /// NaN where the row has no place among the stored values, or a column none in A: nothing reads such an A.
  T largest_in_row(int i) const {
    return is_row(i) ? OperatorRows<Csr, T>::largest_in_row(i) : std::numeric_limits<T>::quiet_NaN();
  }

  template <class F>
  void for_each_entry(int i, const F& f) const {
    for (int64_t k = crow_[i]; k < crow_[i + 1]; ++k) f(values_[k], static_cast<int>(col_[k]));
  }

 private:
  bool is_row(int i) const {
    const int64_t begin = crow_[i], end = crow_[i + 1];
    if (begin < 0 || end < begin || end > stored_) return false;
    if ((i == 0 && begin != 0) || (i == n - 1 && end != stored_)) return false;
    bool inside = true;
    for (int64_t k = begin; k < end; ++k) inside = inside && col_[k] >= 0 && col_[k] < n;
    return inside;
  }

  const int64_t *crow_, *col_;
  const T* values_;
  int64_t stored_;
};

}  // namespace prdp::gpu
