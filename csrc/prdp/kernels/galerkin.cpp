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

/// z, y and x.
using Point = std::array<int64_t, 3>;

/// Coarse points of one row that a call of the loops makes. Where z or y is coarsened, the whole row, whose points all
/// have the same neighbours. Where x is: its first point, those between, or its last, as only the ends may lack one.
struct CoarseRun {
  GridRow row;  // of the coarse grid
  int64_t first, count;
};

/// The fine points at the first point of a run and beside it, along the axis. Without has_before or has_after
/// that neighbour is itself coarse, or there is none.
struct Neighbourhood {
  Point before, here, after;
  bool has_before, has_after;
};

/// Rows of constants in place of coefficients and weights that are not there.
template <class T>
struct Constants {
  std::vector<T> zeros, ones;
  explicit Constants(int64_t n) : zeros(n, T(0)), ones(n, T(1)) {}
};

/// Offsets -1, 0 and 1 along the axis.
enum Along { kLower, kHere, kUpper };

/// The coarse coefficients with one offset in the other axes, and what they are made of.
template <class T>
class CoarseCoefficients {
 public:
  /// `centre`: the place of that offset in a stencil, with offset 0 along the axis.
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
  bool is_empty() const { return !fine_[kLower] && !fine_[kHere] && !fine_[kUpper]; }
  /// Adds those with offset -1, 0 and 1 along the axis to a coarse operator, for make() to fill.
  void add_to(StencilFields<T>& coarse, int centre) {
    for (int d = 0; d < 3; ++d) coarse_[d] = coarse.add(place(centre, d));
  }

  void make(const CoarseRun& run) const {
    const auto [before, here, after, has_before, has_after] = around(run);
    const T *const zeros = constants_.zeros.data(), *const ones = constants_.ones.data();
    const auto coefficient = [&](Along d, const Point& p) {
      return fine_[d] ? fine_[d] + (p[0] * a_.grid.shape[1] + p[1]) * a_.grid.shape[2] + p[2] : zeros;
    };
    const bool has_sides = fine_[kLower] || fine_[kUpper];
    const auto side = [&](Along d, const Point& p) { return has_sides ? coefficient(d, p) : nullptr; };
    const auto weight_of_row = [&](const Field<T>& weights, const Point& p) {
      return weights.data() + ringed_.at(p[0], p[1], p[2]);
    };
    // A coefficient couples a row of A, this point, to a column, the point at its offset in the other axes. Restriction
    // is that of the row, interpolation that of the column.
    const auto weight_of_column = [&](const Field<T>& weights, const Point& p) {
      const auto& o = offset_.along;
      return weights.data() + ringed_.at(p[0] + o[0], p[1] + o[1], p[2] + o[2]);
    };
    // A neighbour that is itself coarse is interpolated from itself alone, and nothing is restricted from it.
    const auto& [interpolation, restriction] = transfer_;
    const int64_t to = run.row.first + run.first;
    const GalerkinProduct<T> product{.lower_before = side(kLower, before),
                                     .lower_here = side(kLower, here),
                                     .lower_after = side(kLower, after),
                                     .centre_before = coefficient(kHere, before),
                                     .centre_here = coefficient(kHere, here),
                                     .centre_after = coefficient(kHere, after),
                                     .upper_before = side(kUpper, before),
                                     .upper_here = side(kUpper, here),
                                     .upper_after = side(kUpper, after),
                                     .before_left = has_before ? weight_of_column(interpolation.left, before) : ones,
                                     .before_right = has_before ? weight_of_column(interpolation.right, before) : zeros,
                                     .after_left = has_after ? weight_of_column(interpolation.left, after) : zeros,
                                     .after_right = has_after ? weight_of_column(interpolation.right, after) : ones,
                                     .restrict_before = has_before ? weight_of_row(restriction.right, before) : zeros,
                                     .restrict_after = has_after ? weight_of_row(restriction.left, after) : zeros,
                                     .left = coarse_[kLower] + to,
                                     .centre = coarse_[kHere] + to,
                                     .right = coarse_[kUpper] + to};
    loops<T>().galerkin_product(product, /*step=*/axis_ == 2 ? 2 : 1, run.count);
  }

 private:
  Neighbourhood around(const CoarseRun& run) const {
    const Point coarse{run.row.z, run.row.y, run.first};
    const int64_t extent = a_.grid.shape[axis_];
    const bool periodic = a_.grid.periodic[axis_];
    const int64_t here = 2 * coarse[axis_] + !periodic;
    const auto fine = [&](int64_t along_axis) {
      Point p = coarse;
      p[axis_] = (along_axis + extent) % extent;
      return p;
    };
    // Periodic with an odd number: the first and the last point are both coarse, and nothing lies between them. Ended
    // by zeros with an even number: the last point is coarse.
    return {fine(here - 1), fine(here), fine(here + 1), here > 0 || (periodic && extent % 2 == 0), here + 1 < extent};
  }
  /// Of the coefficient with offset d - 1 along the axis, and those of `centre` in the others.
  int place(int centre, int d) const { return centre + (d - 1) * (axis_ == 0 ? 9 : axis_ == 1 ? 3 : 1); }

  const StencilFields<T>& a_;
  int axis_;
  const AxisTransfer<T>& transfer_;
  const Constants<T>& constants_;
  RingedGrid ringed_;
  Offset offset_;     // in the other axes
  const T* fine_[3];  // of each Along; null: there are none
  T* coarse_[3] = {};
};

/// See kept_diagonal().
template <class T>
void keep_vanishing_diagonals(const StencilFields<T>& a, int axis, StencilFields<T>& coarse) {
  const T* const fine = a.coefficients[StencilFields<T>::kCentre];
  T* const diagonal = const_cast<T*>(coarse.coefficients[StencilFields<T>::kCentre]);  // of memory that `coarse` owns
  const auto is_alone = [&](int64_t i) {
    for (int k = 0; k < 27; ++k)
      if (k != StencilFields<T>::kCentre && coarse.coefficients[k] && coarse.coefficients[k][i] != T(0)) return false;
    return true;
  };
  const auto fine_index = [&](int d, int64_t i) { return d == axis ? 2 * i + !a.grid.periodic[d] : i; };
  const int64_t step = axis == 2 ? 2 : 1;
  for_each_row(coarse.grid, [&](const GridRow& row) {
    const int64_t first =
        (fine_index(0, row.z) * a.grid.shape[1] + fine_index(1, row.y)) * a.grid.shape[2] + fine_index(2, 0);
    for (int64_t i = 0; i < coarse.grid.shape[2]; ++i) {
      T& own = diagonal[row.first + i];
      own = kept_diagonal(own, fine[first + step * i], [&] { return is_alone(row.first + i); });
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
    for_each_row(coarse.grid, [&](const GridRow& row) {
      if (axis != 2) return part.make({row, 0, a.grid.shape[2]});  // as long as the fine row
      part.make({row, 0, 1});
      if (count > 2) part.make({row, 1, count - 2});
      if (count > 1) part.make({row, count - 1, 1});
    });
  }
  if (periodic && count == 1) fold_onto_centre(coarse, axis);
  keep_vanishing_diagonals(a, axis, coarse);
  return coarse;
}

template <class T>
bool is_symmetric(const StencilFields<T>& a) {
  std::atomic<bool> symmetric = true;
  for (int k = 0; k < StencilFields<T>::kCentre; ++k) {
    const T *one = a.coefficients[k], *opposite = a.coefficients[26 - k];
    if (!one && !opposite) continue;
    if (!one || !opposite) return false;
    for_each_row(a.grid, [&](const GridRow& row) {
      const NeighboursOfRow neighbours(a.grid, row, StencilFields<T>::offset(k));
      if (!neighbours.exist() || !symmetric) return;
      bool same = true;
      for (int64_t i = 0; i < a.grid.shape[2]; ++i) {
        const int64_t there = neighbours.of(i);
        same &= there < 0 || one[row.first + i] == opposite[there];
      }
      if (!same) symmetric = false;
    });
  }
  return symmetric;
}

template StencilFields<float> galerkin_product(const StencilFields<float>&, int, const AxisTransfer<float>&);
template StencilFields<double> galerkin_product(const StencilFields<double>&, int, const AxisTransfer<double>&);
template bool is_symmetric(const StencilFields<float>&);
template bool is_symmetric(const StencilFields<double>&);

}  // namespace prdp::kernels
