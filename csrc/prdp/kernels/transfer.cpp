#include "prdp/kernels/transfer.h"

#include <algorithm>

#include "prdp/kernels/loops.h"
#include "prdp/kernels/whole_vectors.h"

namespace prdp::kernels {

namespace {

/// What a thread splits a row of n points into: coarse points and those between, with room for what lies beyond the
/// ends.
template <class T>
struct SplitRows {
  std::vector<T> coarse, between;

  static SplitRows& local(int64_t n) {
    static thread_local SplitRows rows;
    const auto size = static_cast<size_t>(n + 4);
    for (auto* row : {&rows.coarse, &rows.between})
      if (row->size() < size) row->resize(size);
    return rows;
  }
};

}  // namespace

template <class T>
Transfer<T>::Transfer(const StencilGrid& grid, int axis, const AxisTransfer<T>& weights, bool symmetric)
    : fine_(grid),
      coarse_(grid),
      axis_(axis),
      periodic_(grid.periodic[axis]),
      first_coarse_(periodic_ ? 0 : 1),
      first_between_(1 - first_coarse_),
      zeros_(grid.shape[2], T(0)) {
  coarse_.shape[axis] = coarse_points(grid.shape[axis], periodic_);
  interpolation_ = compress(weights.interpolation);
  if (!symmetric) restriction_ = compress(weights.restriction);
}

template <class T>
int64_t Transfer<T>::bytes() const {
  return static_cast<int64_t>((interpolation_.left.size() + restriction_.left.size()) * 2 * sizeof(T));
}

template <class T>
int64_t Transfer<T>::weights_at(int64_t z, int64_t y) const {
  const int64_t row = axis_ == 2 ? between() + 2 : fine_.shape[2], rows = axis_ == 1 ? between() : fine_.shape[1];
  return (z * rows + y) * row;
}

template <class T>
typename Transfer<T>::Compressed Transfer<T>::compress(const Weights<T>& weights) const {
  const auto& [nz, ny, nx] = fine_.shape;
  const RingedGrid ringed(fine_);
  const int64_t count = between();
  int64_t extent[3] = {nz, ny, nx};
  extent[axis_] = axis_ == 2 ? count + 2 : count;
  Compressed c;
  for (const auto& [all, some] : {std::pair(&weights.left, &c.left), std::pair(&weights.right, &c.right)}) {
    some->assign(extent[0] * extent[1] * extent[2], T(0));
    for (int64_t z = 0; z < extent[0]; ++z)
      for (int64_t y = 0; y < extent[1]; ++y) {
        T* const to = some->data() + weights_at(z, y);
        const int64_t fine_z = axis_ == 0 ? 2 * z + first_between_ : z;
        const int64_t fine_y = axis_ == 1 ? 2 * y + first_between_ : y;
        const T* const row = all->data() + ringed.at(fine_z, fine_y, 0);
        if (axis_ != 2) {
          std::copy_n(row, nx, to);
          continue;
        }
        for (int64_t k = 0; k < count; ++k) to[k + 1] = row[2 * k + first_between_];
        if (periodic_ && nx % 2 == 0) to[0] = to[count];  // the last point lies before the first, too
      }
  }
  return c;
}

template <class T>
template <class Body>
void Transfer<T>::for_each_row(const PaddedGrid& grid, const Body& body) const {
  const int64_t of_field = grid.shape[0] * grid.shape[1];
  for_each_run_of_rows(grid.fields * of_field, grid.row, [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r) body(r / of_field, r % of_field / grid.shape[1], r % grid.shape[1]);
  });
}

template <class T>
template <class AlongX, class Across>
void Transfer<T>::make_rows(const PaddedGrid& from, const T* in, const PaddedGrid& to, T* out, const Compressed& w,
                            const AlongX& along_x, const Across& across) const {
  for_each_row(to, [&](int64_t f, int64_t z, int64_t y) {
    T* const made = out + to.at(f, z, y);
    if (axis_ == 2) {
      const int64_t at = weights_at(z, y);
      return along_x(in + from.at(f, z, y), w.left.data() + at, w.right.data() + at, made);
    }
    const auto row = [&](int64_t i) { return in + (axis_ == 0 ? from.at(f, i, y) : from.at(f, z, i)); };
    const auto weight = [&](const std::vector<T>& field, int64_t k) {
      return field.data() + (axis_ == 0 ? weights_at(k, y) : weights_at(z, k));
    };
    across(axis_ == 0 ? z : y, row, w, weight, made);
  });
}

template <class T>
void Transfer<T>::restrict_along_x(const T* fine, const T* left, const T* right, T* coarse) const {
  const auto& loops = kernels::loops<T>();
  const int64_t nx = fine_.shape[2], count = between();
  auto& rows = SplitRows<T>::local(nx);
  // The points between start at place 1: place 0 is for what lies before the first coarse point.
  T *coarse_points = rows.coarse.data(), *between_points = rows.between.data();
  if (first_coarse_ == 0) loops.split(fine, coarse_points, between_points + 1, nx);
  else loops.split(fine, between_points + 1, coarse_points, nx);
  // Where the last C meets the first, on an odd periodic axis, compress() has left a weight of zero for it.
  between_points[0] = between_points[count];
  between_points[count + 1] = T(0);
  const int64_t first_before = first_coarse_, first_after = first_before + 1;  // of the first coarse point
  loops.restrict_row(coarse_points, between_points + first_before, right + first_before, between_points + first_after,
                     left + first_after, coarse, coarse_.shape[2]);
}

template <class T>
template <class Row, class Weight>
void Transfer<T>::restrict_row(int64_t j, const Row& row, const Compressed& w, const Weight& weight, T* coarse) const {
  struct Beside {
    const T *row, *weight;
  };
  const Beside none{zeros_.data(), zeros_.data()};
  const int64_t n = fine_.shape[axis_], here = 2 * j + first_coarse_;
  const bool wraps = here == 0 && periodic_ && n % 2 == 0;
  const auto before = wraps      ? Beside{row(n - 1), weight(w.right, between() - 1)}
                      : here > 0 ? Beside{row(here - 1), weight(w.right, (here - 1) / 2)}
                                 : none;
  const auto after = here + 1 < n ? Beside{row(here + 1), weight(w.left, (here + 1) / 2)} : none;
  loops<T>().restrict_row(row(here), before.row, before.weight, after.row, after.weight, coarse, fine_.shape[2]);
}

template <class T>
void Transfer<T>::restrict(const PaddedGrid& from, const T* fine, const PaddedGrid& to, T* coarse,
                           bool transposed) const {
  make_rows(
      from, fine, to, coarse, of_restriction(transposed), [this](auto... row) { restrict_along_x(row...); },
      [this](const auto&... row) { restrict_row(row...); });
}

template <class T>
void Transfer<T>::interpolate_along_x(const T* coarse, const T* left, const T* right, T* fine) const {
  const auto& loops = kernels::loops<T>();
  const int64_t nx = fine_.shape[2], coarse_count = coarse_.shape[2], count = between();
  auto& rows = SplitRows<T>::local(nx);
  // The coarse points start at place 1: place 0 is for what lies before the first point between.
  T *coarse_points = rows.coarse.data(), *between_points = rows.between.data();
  std::copy_n(coarse, coarse_count, coarse_points + 1);
  coarse_points[0] = T(0);
  coarse_points[coarse_count + 1] = periodic_ ? coarse_points[1] : T(0);
  std::fill_n(between_points, count, T(0));
  const int64_t first_before = first_between_, first_after = first_before + 1;  // of the first point between
  loops.add_interpolated(coarse_points + first_before, left + 1, coarse_points + first_after, right + 1, between_points,
                         count);
  if (first_coarse_ == 0) loops.add_merged(coarse_points + 1, between_points, fine, nx);
  else loops.add_merged(between_points, coarse_points + 1, fine, nx);
}

template <class T>
template <class Row, class Weight>
void Transfer<T>::interpolate_row(int64_t i, const Row& row, const Compressed& w, const Weight& weight, T* fine) const {
  const int64_t nx = fine_.shape[2], coarse_count = coarse_.shape[axis_], k = i / 2;
  if (i % 2 == first_coarse_) return loops<T>().axpy(T(1), row(k), fine, nx);
  const int64_t left = k - first_coarse_, right = periodic_ ? (k + 1) % coarse_count : k;
  const T* const row_left = left >= 0 ? row(left) : zeros_.data();
  const T* const row_right = right < coarse_count ? row(right) : zeros_.data();
  loops<T>().add_interpolated(row_left, weight(w.left, k), row_right, weight(w.right, k), fine, nx);
}

template <class T>
void Transfer<T>::add_interpolated(const PaddedGrid& from, const T* coarse, const PaddedGrid& to, T* fine,
                                   bool transposed) const {
  make_rows(
      from, coarse, to, fine, of_interpolation(transposed), [this](auto... row) { interpolate_along_x(row...); },
      [this](const auto&... row) { interpolate_row(row...); });
}

template class Transfer<float>;
template class Transfer<double>;

}  // namespace prdp::kernels
