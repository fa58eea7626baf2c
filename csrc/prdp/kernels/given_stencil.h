#pragma once
#include <algorithm>
#include <numeric>

#include "prdp/kernels/assembly.h"
#include "prdp/kernels/stencil.h"

namespace prdp::kernels {

/// The row sums that products keep, see PackedStencil::set_row_sums(): (batch, nz, ny, nx), or one number for all.
template <class T>
struct RowSums {
  const T* values = nullptr;  // null: nothing is said of that
  int64_t sample_stride = 0;  // 0: all samples share them
  bool is_number = false;
  std::vector<Offset> offsets = {};  // those of the coefficients; none: these lead nowhere beyond the grid
};

/// The stencils with `coefficients` (batch, k, nz, ny, nx) for the offsets that `pattern` was given, or their
/// transposes: the stencils of the opposite offsets, of which `pattern` is then to be.
template <class T>
struct GivenStencil {
  const T* coefficients;
  int64_t sample_stride;  // 0: all samples share them
  std::shared_ptr<const StencilSparsity> pattern;
  bool transposed;
  RowSums<T> row_sums = {};

  /// Whether apply() may be used: each given offset leads to a neighbour of its own, and products are of values.
  bool is_one_to_one() const {
    if (row_sums.values) return false;
    auto places = pattern->places;
    std::sort(places.begin(), places.end());
    return places.front() >= 0 && std::adjacent_find(places.begin(), places.end()) == places.end();
  }
  /// out = A v on each channel of a sample, from the coefficients where they lie, if they are one to one. Every point
  /// adds up its products in the order of the kernel.
  void apply(int64_t s, int64_t channels, const T* v, T* out) const {
    const auto& [nz, ny, nx] = pattern->grid.shape;
    const int64_t points = nz * ny * nx;
    std::vector<const T*> fields(pattern->offsets.size());
    for (size_t given = 0; given < pattern->places.size(); ++given)
      fields[pattern->places[given]] = coefficients + s * sample_stride + static_cast<int64_t>(given) * points;
    std::vector<size_t> order(fields.size());
    std::iota(order.begin(), order.end(), 0);
    if (pattern->nearest) std::swap(order[0], order[1]);  // where its loop fuses the first two products and their sum
    const std::vector<T> zeros(nx);
    for (int64_t c = 0; c < channels; ++c)
      for_each_run_of_rows(nz * ny, nx, [&](int64_t begin, int64_t end) {
        for (int64_t r = begin; r < end; ++r) {
          T* const row = out + c * points + r * nx;
          std::fill_n(row, nx, T(0));
          for (const bool wraps : {false, true})  // what leaves a periodic row is added last
            if (!wraps || pattern->grid.periodic[2])
              for (const size_t k : order)
                if (fields[k]) add_to_row(pattern->offsets[k], fields[k], v + c * points, r, wraps, zeros.data(), row);
        }
      });
  }

  /// Null where a coefficient is not finite.
  std::unique_ptr<Kernel<T>> make(int64_t s, int64_t channels) const {
    const auto& [nz, ny, nx] = pattern->grid.shape;
    const int64_t points = nz * ny * nx, given = static_cast<int64_t>(pattern->places.size());
    const T* from = coefficients + s * sample_stride;
    const T magnitude = largest_magnitude(from, given * points);
    if (!std::isfinite(magnitude)) return nullptr;
    std::vector<const T*> fields;
    for (int64_t k = 0; k < given; ++k) fields.push_back(from + k * points);
    const T factor = scale_of_operator(magnitude);
    auto rows = std::make_shared<PackedStencil<T>>(assemble_rows(pattern, fields, factor, transposed));
    const T* const values_of_sample = row_sums.values ? row_sums.values + s * row_sums.sample_stride : nullptr;
    if (values_of_sample) set_row_sums(*rows, values_of_sample, fields, factor);
    // Both outlive this struct, of which they hold a copy.
    const auto key = [*this, from, values_of_sample, count = given * points, points] {
      auto made = key_of_pattern().add_field(from, count);
      return values_of_sample ? made.add_field(values_of_sample, row_sums.is_number ? 1 : points).key() : made.key();
    };
    const auto as_fields = [*this, fields, factor, points] { return fields_of_multigrid(fields, factor, points); };
    return std::make_unique<Stencil<T>>(std::move(rows), channels, factor,
                                        typename Stencil<T>::Source{key, as_fields, transposed});
  }

 private:
  /// The values given, and what the points at the sides of the grid are coupled to zeros beyond it by.
  void set_row_sums(PackedStencil<T>& rows, const T* values, const std::vector<const T*>& fields, T factor) const {
    rows.set_row_sums(values, row_sums.is_number, factor);
    const auto& n = pattern->grid.shape;
    for (size_t given = 0; given < row_sums.offsets.size(); ++given) {
      const auto& along = row_sums.offsets[given].along;
      for (int64_t r = 0; r < n[0] * n[1]; ++r)
        for (int64_t axis = 0; axis < 3; ++axis) {
          if (along[axis] == 0 || pattern->grid.periodic[axis]) continue;
          const int64_t side = along[axis] < 0 ? 0 : n[axis] - 1;
          if (axis < 2 && (axis == 0 ? r / n[1] : r % n[1]) != side) continue;
          for (int64_t i = axis < 2 ? 0 : side; i < (axis < 2 ? n[2] : side + 1); ++i)
            rows.add_to_row_sum(r, i, -factor * fields[given][r * n[2] + i]);
        }
    }
  }
  /// The products of one coefficient in row r: with neighbours in their row or with those that leave it. Beyond the
  /// grid there are zeros.
  void add_to_row(const Offset& offset, const T* field, const T* v, int64_t r, bool wraps, const T* zeros,
                  T* row) const {
    const auto& [nz, ny, nx] = pattern->grid.shape;
    const auto& periodic = pattern->grid.periodic;
    const auto& loops = kernels::loops<T>();
    const int64_t z = neighbour(r / ny, offset.along[0], nz, periodic[0]);
    const int64_t y = neighbour(r % ny, offset.along[1], ny, periodic[1]), there = (z * ny + y) * nx;
    const bool outside = z < 0 || y < 0;
    if (outside && (transposed || wraps)) return;
    if (outside) return loops.add_product(field + r * nx, zeros, row, nx);
    const Run x = runs(offset.along[2], nx, periodic[2], /*transposed=*/true)[wraps ? 1 : 0];
    loops.add_product(transposed ? field + there + x.from : field + r * nx + x.to, v + there + x.from, row + x.to,
                      x.count);
    if (transposed || periodic[2]) return;
    loops.add_product(field + r * nx, zeros, row, x.to);
    loops.add_product(field + r * nx + x.to + x.count, zeros, row + x.to + x.count, nx - x.to - x.count);
  }
  /// The part of the key that tells the grid and the offsets, as they are in the matrix that is not transposed.
  FactorKeyMaker key_of_pattern() const {
    FactorKeyMaker key;
    const auto& grid = pattern->grid;
    for (int d = 0; d < 3; ++d) key.add(grid.shape[d]).add(int64_t{grid.periodic[d]});
    for (const int64_t k : pattern->places) {
      if (k < 0) key.add(int64_t{3});
      else key.add(untransposed(k).along, 3);
    }
    return key;
  }
  Offset untransposed(int64_t k) const {
    Offset o = pattern->offsets[k];
    if (transposed)
      for (auto& cells : o.along) cells = -cells;
    return o;
  }
  /// The coefficients, times the factor, as multigrid takes them; nothing if neighbours lie further away.
  std::optional<StencilFields<T>> fields_of_multigrid(const std::vector<const T*>& fields, T factor,
                                                      int64_t points) const {
    StencilFields<T> a(pattern->grid);
    for (size_t given = 0; given < fields.size(); ++given) {
      const int64_t k = pattern->places[given];
      if (k < 0) continue;
      const Offset o = untransposed(k);
      for (const int64_t cells : o.along)
        if (std::abs(cells) > 1) return std::nullopt;
      const int place = StencilFields<T>::place(o);
      if (factor == T(1) && !a.coefficients[place]) {
        a.coefficients[place] = fields[given];
        continue;
      }
      const T* before = a.coefficients[place];
      T* sum = a.add(place);
      for_each_block_of(points, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) sum[i] = (before ? before[i] : T(0)) + factor * fields[given][i];
      });
    }
    if (!a.coefficients[StencilFields<T>::kCentre]) fill_zero(a.add(StencilFields<T>::kCentre), points);
    return a;
  }
};

}  // namespace prdp::kernels
