#include "prdp/kernels/galerkin.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <limits>
#include <utility>

#include "prdp/kernels/loops.h"
#include "prdp/kernels/whole_vectors.h"

namespace prdp::kernels {

namespace {

/// Points of a grid with a ring of one point around it.
struct Ringed {
  int64_t ny, nx;  // with the ring

  explicit Ringed(const StencilGrid& grid) : ny(grid.shape[1] + 2), nx(grid.shape[2] + 2) {}
  static int64_t size(const StencilGrid& grid) {
    return (grid.shape[0] + 2) * (grid.shape[1] + 2) * (grid.shape[2] + 2);
  }
  int64_t at(int64_t z, int64_t y, int64_t x) const { return ((z + 1) * ny + y + 1) * nx + x + 1; }
};

/// Calls body(z, y, first point of the row) for all rows, on several threads if there are many.
template <class Body>
void for_each_row(const StencilGrid& grid, const Body& body) {
  const int64_t ny = grid.shape[1], nx = grid.shape[2];
  for_each_run_of_rows(grid.shape[0] * ny, nx, [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r) body(r / ny, r % ny, r * nx);
  });
}

/// The row at an offset from row (z, y), where it lies in the grid, or comes round its end; else -1.
int64_t row_at(const StencilGrid& grid, int64_t z, int64_t y, const Offset& o) {
  const int64_t nz = grid.shape[0], ny = grid.shape[1];
  z = neighbour(z, o.along[0], nz, grid.periodic[0]);
  y = neighbour(y, o.along[1], ny, grid.periodic[1]);
  return z < 0 || y < 0 ? -1 : z * ny + y;
}

/// Sums of the coefficients with offset -1, 0 and 1 along the axis: of A, or of Aᵀ.
template <class T>
using Sums = std::array<Field<T>, 3>;

template <class T>
Sums<T> sums_along(const StencilFields<T>& a, int axis, bool transposed) {
  Sums<T> sums;
  for (auto& s : sums) s.resize(a.points());
  const int64_t nx = a.grid.shape[2];
  for_each_row(a.grid, [&](int64_t z, int64_t y, int64_t at) {
    for (auto& s : sums) std::fill_n(s.data() + at, nx, T(0));
    for (int k = 0; k < 27; ++k) {
      const Offset o = StencilFields<T>::offset(k);
      const T *own = a.coefficients[k], *of_transpose = a.coefficients[26 - k];
      if (!(transposed ? of_transpose : own)) continue;
      T* to = sums[o.along[axis] + 1].data() + at;
      if (!transposed) {
        for (int64_t i = 0; i < nx; ++i) to[i] += own[at + i];
        continue;
      }
      // Aᵀ couples i to i + o as A couples i + o to i. Beyond the grid, A's own coefficient stands for it.
      const int64_t row = row_at(a.grid, z, y, o);
      const T* beyond = own ? own : of_transpose;
      for (int64_t i = 0; i < nx; ++i) {
        const int64_t j = row < 0 ? -1 : neighbour(i, o.along[2], nx, a.grid.periodic[2]);
        to[i] += j < 0 ? beyond[at + i] : of_transpose[row * nx + j];
      }
    }
  });
  return sums;
}

/// Fills the ring of a field: the other end of a periodic axis. Else it stays as it is.
template <class T>
void wrap_ring(const StencilGrid& grid, const Ringed& ringed, T* f) {
  const auto& [nz, ny, nx] = grid.shape;
  const auto row = [&](int64_t z, int64_t y) { return f + ringed.at(z, y, -1); };
  if (grid.periodic[2])
    for (int64_t z = 0; z < nz; ++z)
      for (int64_t y = 0; y < ny; ++y) {
        row(z, y)[0] = row(z, y)[nx];
        row(z, y)[nx + 1] = row(z, y)[1];
      }
  if (grid.periodic[1])
    for (int64_t z = 0; z < nz; ++z) {
      std::copy_n(row(z, ny - 1), nx + 2, row(z, -1));
      std::copy_n(row(z, 0), nx + 2, row(z, ny));
    }
  if (grid.periodic[0]) {
    const int64_t plane = ringed.ny * ringed.nx;
    std::copy_n(f + nz * plane, plane, f);
    std::copy_n(f + plane, plane, f + (nz + 1) * plane);
  }
}

/// The weights that the sums of each point give, with their ring: the other end of a periodic axis, else zeros.
template <class T>
Weights<T> weights_of(const StencilFields<T>& a, const Sums<T>& sums, const Sums<T>* averaged_with = nullptr) {
  const StencilGrid& grid = a.grid;
  const T* diagonal = a.coefficients[StencilFields<T>::kCentre];
  const Ringed ringed(grid);
  Weights<T> w{zeros<T>(Ringed::size(grid)), zeros<T>(Ringed::size(grid))};
  for_each_row(grid, [&](int64_t z, int64_t y, int64_t at) {
    T *left = w.left.data() + ringed.at(z, y, 0), *right = w.right.data() + ringed.at(z, y, 0);
    for (int64_t i = 0; i < grid.shape[2]; ++i) {
      T s[3] = {sums[0][at + i], sums[1][at + i], sums[2][at + i]};
      if (averaged_with)
        for (int d = 0; d < 3; ++d) s[d] += (*averaged_with)[d][at + i];
      const WeightsOfPoint<T> of_point(diagonal[at + i], s[0], s[1], s[2]);
      left[i] = of_point.left;
      right[i] = of_point.right;
    }
  });
  for (auto* field : {&w.left, &w.right}) wrap_ring(grid, ringed, field->data());
  return w;
}

/// Constants in place of the weights of a neighbour that is not there.
template <class T>
struct Constants {
  std::vector<T> zeros, ones;
  explicit Constants(int64_t n) : zeros(n, T(0)), ones(n, T(1)) {}
};

/// The coarse coefficients with one offset in the other axes, and what they are made of.
template <class T>
class CoarseCoefficients {
 public:
  CoarseCoefficients(const StencilFields<T>& a, int axis, const AxisTransfer<T>& transfer,
                     const Constants<T>& constants, int centre)
      : a_(a),
        axis_(axis),
        transfer_(transfer),
        constants_(constants),
        ringed_(a.grid),
        offset_(StencilFields<T>::offset(centre)) {
    for (int d = 0; d < 3; ++d) fine_[d] = a.coefficients[place(centre, d)];
  }
  bool is_empty() const { return !fine_[0] && !fine_[1] && !fine_[2]; }
  /// Adds those with offset -1, 0 and 1 along the axis to a coarse operator, for points() to fill.
  void add_to(StencilFields<T>& coarse, int centre) {
    for (int d = 0; d < 3; ++d) out_[d] = coarse.add(place(centre, d));
  }

  /// The coarse points from `first` on, n of them: of a row along x, or of x itself if that is the axis.
  void points(int64_t z, int64_t y, int64_t x, int64_t n, int64_t coarse, int64_t to) const {
    const int64_t extent = a_.grid.shape[axis_];
    const bool periodic = a_.grid.periodic[axis_];
    const int64_t here = 2 * coarse + !periodic;
    // An odd ring has no point between its last and its first; a line of an even number has none behind its last.
    const bool has_before = here > 0 || (periodic && extent % 2 == 0);
    const bool has_after = here + 1 < extent;
    const auto along = [&](int64_t i) {
      const int64_t at = (i + extent) % extent;
      return std::array<int64_t, 3>{axis_ == 0 ? at : z, axis_ == 1 ? at : y, axis_ == 2 ? at : x};
    };
    const auto before = along(here - 1), middle = along(here), after = along(here + 1);
    const auto coefficient = [&](int d, const std::array<int64_t, 3>& p) -> const T* {
      if (!fine_[d]) return has_sides() ? constants_.zeros.data() : nullptr;
      return fine_[d] + (p[0] * a_.grid.shape[1] + p[1]) * a_.grid.shape[2] + p[2];
    };
    const auto weight = [&](const Field<T>& field, const std::array<int64_t, 3>& p, bool of_column) {
      const auto& o = offset_.along;
      return field.data() +
             (of_column ? ringed_.at(p[0] + o[0], p[1] + o[1], p[2] + o[2]) : ringed_.at(p[0], p[1], p[2]));
    };
    const T *zeros = constants_.zeros.data(), *ones = constants_.ones.data();
    const auto& [p, r] = transfer_;
    const GalerkinProduct<T> c{.lower_before = coefficient(0, before),
                               .lower_here = coefficient(0, middle),
                               .lower_after = coefficient(0, after),
                               .centre_before = fine_[1] ? coefficient(1, before) : zeros,
                               .centre_here = fine_[1] ? coefficient(1, middle) : zeros,
                               .centre_after = fine_[1] ? coefficient(1, after) : zeros,
                               .upper_before = coefficient(2, before),
                               .upper_here = coefficient(2, middle),
                               .upper_after = coefficient(2, after),
                               .before_left = has_before ? weight(p.left, before, true) : ones,
                               .before_right = has_before ? weight(p.right, before, true) : zeros,
                               .after_left = has_after ? weight(p.left, after, true) : zeros,
                               .after_right = has_after ? weight(p.right, after, true) : ones,
                               .restrict_before = has_before ? weight(r.right, before, false) : zeros,
                               .restrict_after = has_after ? weight(r.left, after, false) : zeros,
                               .left = out_[0] + to,
                               .centre = out_[1] + to,
                               .right = out_[2] + to};
    loops<T>().galerkin_product(c, axis_ == 2 ? 2 : 1, n);
  }

 private:
  bool has_sides() const { return fine_[0] || fine_[2]; }
  int place(int centre, int d) const { return centre + (d - 1) * (axis_ == 0 ? 9 : axis_ == 1 ? 3 : 1); }

  const StencilFields<T>& a_;
  int axis_;
  const AxisTransfer<T>& transfer_;
  const Constants<T>& constants_;
  Ringed ringed_;
  Offset offset_;     // in the other axes
  const T* fine_[3];  // with offset -1, 0, 1 along the axis
  T* out_[3] = {};
};

}  // namespace

template <class T>
AxisTransfer<T> make_transfer(const StencilFields<T>& a, int axis, bool symmetric) {
  const auto own = sums_along(a, axis, false);
  if (symmetric) {
    auto w = weights_of(a, own);
    return {w, w};
  }
  const auto of_transpose = sums_along(a, axis, true);
  return {weights_of(a, own, &of_transpose), weights_of(a, of_transpose)};
}

namespace {

/// See kVanishing.
template <class T>
void keep_vanishing_diagonals(const StencilFields<T>& a, int axis, StencilFields<T>& coarse) {
  const T* const fine = a.coefficients[StencilFields<T>::kCentre];
  T* const diagonal = const_cast<T*>(coarse.coefficients[StencilFields<T>::kCentre]);  // in its own memory
  const auto is_alone = [&](int64_t i) {
    for (int k = 0; k < 27; ++k)
      if (k != StencilFields<T>::kCentre && coarse.coefficients[k] && coarse.coefficients[k][i] != T(0)) return false;
    return true;
  };
  const auto roundings = [](double n) { return static_cast<T>(n) * std::numeric_limits<T>::epsilon(); };
  const T tiny = roundings(kVanishing), tiny_alone = roundings(kVanishingAlone);
  const auto of_coarse = [&](int d, int64_t i) { return d == axis ? 2 * i + !a.grid.periodic[d] : i; };
  const int64_t step = axis == 2 ? 2 : 1;
  for_each_row(coarse.grid, [&](int64_t z, int64_t y, int64_t at) {
    const int64_t first = (of_coarse(0, z) * a.grid.shape[1] + of_coarse(1, y)) * a.grid.shape[2] + of_coarse(2, 0);
    for (int64_t i = 0; i < coarse.grid.shape[2]; ++i) {
      const T kept = fine[first + step * i], size = std::abs(diagonal[at + i]);
      if (size > tiny_alone * std::abs(kept)) continue;
      if (size <= tiny * std::abs(kept) || is_alone(at + i)) diagonal[at + i] = kept;
    }
  });
}

/// The only point of a periodic axis is its own neighbour.
template <class T>
void fold_onto_centre(StencilFields<T>& a, int axis) {
  for (int k = 0; k < 27; ++k) {
    auto to = StencilFields<T>::offset(k);
    if (!a.coefficients[k] || to.along[axis] == 0) continue;
    to.along[axis] = 0;
    const int centre = StencilFields<T>::place(to);
    const T* const more = std::exchange(a.coefficients[k], nullptr);
    const T* const own = a.coefficients[centre];
    T* const sum = a.add(centre);
    for (int64_t i = 0; i < a.points(); ++i) sum[i] = own[i] + more[i];
  }
}

}  // namespace

template <class T>
StencilFields<T> galerkin_product(const StencilFields<T>& a, int axis, const AxisTransfer<T>& transfer) {
  const bool periodic = a.grid.periodic[axis];
  StencilFields<T> coarse(a.grid);
  const int64_t count = coarse_points(a.grid.shape[axis], periodic);
  coarse.grid.shape[axis] = count;
  const Constants<T> constants(a.grid.shape[2] + 2);
  for (int centre = 0; centre < 27; ++centre) {
    if (StencilFields<T>::offset(centre).along[axis] != 0) continue;
    CoarseCoefficients<T> part(a, axis, transfer, constants, centre);
    if (part.is_empty()) continue;
    part.add_to(coarse, centre);
    for_each_row(coarse.grid, [&](int64_t z, int64_t y, int64_t to) {
      if (axis != 2) return part.points(z, y, 0, a.grid.shape[2], axis == 0 ? z : y, to);
      // The ends of a row may lack a neighbour.
      part.points(z, y, 0, 1, 0, to);
      if (count > 2) part.points(z, y, 0, count - 2, 1, to + 1);
      if (count > 1) part.points(z, y, 0, 1, count - 1, to + count - 1);
    });
  }
  if (periodic && count == 1) fold_onto_centre(coarse, axis);
  keep_vanishing_diagonals(a, axis, coarse);
  return coarse;
}

template <class T>
bool is_symmetric(const StencilFields<T>& a) {
  const int64_t nx = a.grid.shape[2];
  std::atomic<bool> symmetric = true;
  for (int k = 0; k < StencilFields<T>::kCentre; ++k) {
    const T *one = a.coefficients[k], *other = a.coefficients[26 - k];
    if (!one && !other) continue;
    if (!one || !other) return false;
    const Offset o = StencilFields<T>::offset(k);
    for_each_row(a.grid, [&](int64_t z, int64_t y, int64_t at) {
      const int64_t row = row_at(a.grid, z, y, o);
      if (row < 0 || !symmetric) return;
      bool same = true;
      for (int64_t i = 0; i < nx; ++i) {
        const int64_t j = neighbour(i, o.along[2], nx, a.grid.periodic[2]);
        same &= j < 0 || one[at + i] == other[row * nx + j];
      }
      if (!same) symmetric = false;
    });
  }
  return symmetric;
}

template AxisTransfer<float> make_transfer(const StencilFields<float>&, int, bool);
template AxisTransfer<double> make_transfer(const StencilFields<double>&, int, bool);
template StencilFields<float> galerkin_product(const StencilFields<float>&, int, const AxisTransfer<float>&);
template StencilFields<double> galerkin_product(const StencilFields<double>&, int, const AxisTransfer<double>&);
template bool is_symmetric(const StencilFields<float>&);
template bool is_symmetric(const StencilFields<double>&);

}  // namespace prdp::kernels
