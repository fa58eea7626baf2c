#include "prdp/operators/separability.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// t (batch or 1, n) as a field that varies along this axis alone.
at::Tensor along(const at::Tensor& t, int64_t axis, int64_t dim) {
  std::vector<int64_t> sizes(dim + 1, 1);
  sizes[0] = t.size(0);
  sizes[1 + axis] = t.size(1);
  return t.reshape(sizes);
}

}  // namespace

Separability::Separability(const at::Tensor& coefficients, const std::vector<bool>& periodic)
    : shape_(coefficients.sizes().slice(2).vec()), periodic_(periodic), epsilon_(epsilon_of(coefficients)) {
  std::vector<at::Tensor> lines, ends;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    lines.push_back(middle_line(coefficients, axis));
    ends.push_back(decoupled_ends(coefficients, axis));
  }
  std::vector<at::Tensor> columns;  // as take_apart() expects them, and key() hashes them
  for (const auto& line : lines) columns.push_back(line.flatten(1));
  for (const auto& of_axis : ends) columns.push_back(of_axis.to(coefficients.scalar_type()));
  for (const auto& size : largest_sizes(coefficients, lines, decoupled_planes(ends))) columns.push_back(size);
  host_ = at::cat(columns, 1).to(at::kCPU, at::kDouble).contiguous();
  take_apart(lines);
}

at::Tensor Separability::middle_line(const at::Tensor& coefficients, int64_t axis) const {
  auto line = coefficients;
  for (int64_t d = dim() - 1; d >= 0; --d)
    if (d != axis) line = line.select(2 + d, middle(d));
  return line;
}

at::Tensor Separability::decoupled_ends(const at::Tensor& coefficients, int64_t axis) const {
  if (periodic_[axis]) return at::zeros({coefficients.size(0), 2}, coefficients.options().dtype(at::kBool));
  std::vector<at::Tensor> ends;
  for (const int64_t end : {0, 1}) {
    const int64_t place = end == 0 ? 0 : shape_[axis] - 1, beside = end == 0 ? 1 : shape_[axis] - 2;
    const auto of_plane = coefficients.select(2 + axis, place).narrow(1, 1, 2 * dim()).ne(0).flatten(1);
    const auto of_beside = coefficients.select(2 + axis, beside).select(1, 1 + 2 * axis + end).ne(0).flatten(1);
    ends.push_back(at::cat({of_plane, of_beside}, 1).any(1).logical_not());
  }
  return at::stack(ends, 1);
}

at::Tensor Separability::decoupled_planes(const std::vector<at::Tensor>& ends) const {
  at::Tensor planes;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    if (periodic_[axis]) continue;
    const auto& of_ends = ends[axis];
    const auto between = of_ends.new_zeros({of_ends.size(0), shape_[axis] - 2});
    const auto of_axis = along(at::cat({of_ends.narrow(1, 0, 1), between, of_ends.narrow(1, 1, 1)}, 1), axis, dim());
    planes = planes.defined() ? planes.logical_or(of_axis) : of_axis;
  }
  return planes;
}

std::vector<at::Tensor> Separability::largest_sizes(const at::Tensor& coefficients,
                                                    const std::vector<at::Tensor>& lines,
                                                    const at::Tensor& outer) const {
  const auto largest = [](const at::Tensor& t) { return t.flatten(1).amax(1, /*keepdim=*/true); };
  const auto largest_inside = [&](const at::Tensor& t) {
    return largest(outer.defined() ? t.masked_fill(outer, 0.0) : t);
  };
  const auto size = coefficients.abs(), diagonal = size.select(1, 0);
  return {largest_inside(distance_from_sum(coefficients, lines)), largest_inside(size.sum(1)), largest_inside(diagonal),
          largest_inside(diagonal.reciprocal()), largest(size)};
}

at::Tensor Separability::distance_from_sum(const at::Tensor& coefficients, const std::vector<at::Tensor>& lines) const {
  at::Tensor diagonal;
  std::vector<at::Tensor> apart;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    const auto field = [&](int64_t k) { return along(lines[axis].select(1, k), axis, dim()); };
    const auto of_middle = lines[axis].select(1, 0).narrow(1, middle(axis), 1);
    add_to(diagonal, axis == 0 ? field(0) : field(0) - along(of_middle, axis, dim()));
    for (const int64_t k : {1 + 2 * axis, 2 + 2 * axis}) apart.push_back(coefficients.select(1, k) - field(k));
  }
  apart.push_back(coefficients.select(1, 0) - diagonal);
  return at::stack(apart, 1).abs().amax(1);
}

void Separability::take_apart(const std::vector<at::Tensor>& lines) {
  int64_t column = 0;
  const auto next = [&](int64_t count) { return host_.narrow(1, std::exchange(column, column + count), count); };
  for (const auto& line : lines)
    lines_.push_back(next(line.size(1) * line.size(2)).unflatten(1, {line.size(1), line.size(2)}));
  for (int64_t axis = 0; axis < dim(); ++axis) ends_.push_back(next(2));
  sizes_ = next(host_.size(1) - column);
}

Separability::Sizes Separability::sizes(int64_t s) const {
  const auto of = sizes_.accessor<double, 2>()[s];
  return {of[0], of[1], of[2], of[3], of[4]};
}

bool Separability::is_finite(int64_t s) const { return std::isfinite(sizes(s).largest); }

std::optional<kernels::SumOverAxes> Separability::sum(int64_t s) const {
  const auto [distance_from_sum, norm, diagonal, inverse_diagonal, largest] = sizes(s);
  const double slack = kernels::slack_of_sum(norm, epsilon_);
  const auto box = inner_box(s);
  const bool has_axes = std::all_of(box.shape.begin(), box.shape.end(), [](int64_t n) { return n >= 3; });
  const bool has_even_rows = diagonal * inverse_diagonal <= kernels::kWidestRows;
  if (!has_axes || !has_even_rows || !(distance_from_sum <= slack)) return std::nullopt;
  const auto a = sum_of_lines(s, box);
  const auto is_symmetric = [slack](const Eigen::MatrixXd& m) { return kernels::is_symmetric(m, slack); };
  return std::all_of(a.begin(), a.end(), is_symmetric) ? std::optional(a) : std::nullopt;
}

InnerBox Separability::inner_box(int64_t s) const {
  InnerBox box{std::vector<int64_t>(dim()), shape_};
  for (int64_t axis = 0; axis < dim(); ++axis) {
    const auto ends = ends_[axis].accessor<double, 2>()[s];
    box.first[axis] = ends[0] != 0.0;
    box.shape[axis] -= box.first[axis] + (ends[1] != 0.0);
  }
  return box;
}

kernels::FactorKey Separability::key(int64_t s, int64_t null_vectors, const at::TensorOptions& options) const {
  kernels::FactorKeyMaker key;
  const auto row = host_.select(0, s);  // without the sizes: once A is known to be a sum, lines and ends determine it
  key.add(row.const_data_ptr<double>(), row.size(0) - sizes_.size(1)).add(shape_.data(), dim()).add(null_vectors);
  for (const bool closed : periodic_) key.add(int64_t{closed});
  key.add(static_cast<int64_t>(c10::typeMetaToScalarType(options.dtype())));
  const auto device = options.device();
  return key.add(static_cast<int64_t>(device.type())).add(int64_t{device.index()}).key();
}

kernels::SumOverAxes Separability::sum_of_lines(int64_t s, const InnerBox& box) const {
  kernels::SumOverAxes sum;
  for (auto& a : sum) a.setZero(1, 1);
  for (int64_t axis = 0; axis < dim(); ++axis) {
    const auto line = lines_[axis].accessor<double, 3>()[s];
    const auto diagonal = line[0], before = line[1 + 2 * axis], behind = line[2 + 2 * axis];
    // The diagonal at the middle point counts once, with the last axis.
    const double of_others = axis + 1 == dim() ? 0.0 : diagonal[middle(axis)];
    const int64_t n = box.shape[axis], first = box.first[axis];
    auto& a = sum[3 - dim() + axis];
    a.setZero(n, n);
    for (int64_t i = 0; i < n; ++i) {
      a(i, i) = diagonal[first + i] - of_others;
      if (const auto j = kernels::neighbour(i, -1, n, periodic_[axis]); j >= 0) a(i, j) = before[first + i];
      if (const auto j = kernels::neighbour(i, 1, n, periodic_[axis]); j >= 0) a(i, j) = behind[first + i];
    }
  }
  return sum;
}

}  // namespace prdp
