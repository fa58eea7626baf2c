#include "prdp/operators/cyclic_reduction.h"

#include <cmath>

#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// t with so many zeros before and behind it along its last axis.
at::Tensor padded(const at::Tensor& t, int64_t before, int64_t behind) {
  return at::constant_pad_nd(t, {before, behind});
}

}  // namespace

CyclicReduction::CyclicReduction(const at::Tensor& coefficients, double slack)
    : slack_(slack), n_(coefficients.size(-1)), coefficients_(coefficients) {
  const int64_t m = n_ - 1;
  if (m == 0) return;
  const auto diagonal = coefficients.select(1, 0), before = coefficients.select(1, 1),
             behind = coefficients.select(1, 2);
  pivot_ = diagonal.narrow(1, 0, m);
  corner_ = diagonal.narrow(1, m, 1);
  lower_ = padded(before.narrow(1, 1, m - 1), 1, 0);
  upper_ = padded(behind.narrow(1, 0, m - 1), 0, 1);
  // Where n is 2 both ends are the same point, and add up.
  column_ = padded(before.narrow(1, 0, 1), 0, m - 1) + padded(behind.narrow(1, m - 1, 1), m - 1, 0);
  border_ = padded(behind.narrow(1, m, 1), 0, m - 1) + padded(before.narrow(1, m, 1), m - 1, 0);
}

at::Tensor CyclicReduction::is_dominant() const {
  const auto unknown = coefficients_.isfinite().flatten(1).all(1).logical_not();
  if (n_ == 1) return at::ones_like(unknown);
  const int64_t m = n_ - 1;
  const auto weighs = [&](const at::Tensor& beside, const at::Tensor& last) {
    return beside.le(pivot_.abs() * (1.0 + slack_))
        .all(1)
        .logical_and(last.abs().sum(1).le(corner_.squeeze(1).abs() * (1.0 + slack_)));
  };
  const auto above = padded(upper_.narrow(1, 0, m - 1), 1, 0), below = padded(lower_.narrow(1, 1, m - 1), 0, 1);
  const auto by_rows = weighs(lower_.abs() + upper_.abs() + column_.abs(), border_);
  const auto by_columns = weighs(above.abs() + below.abs() + border_.abs(), column_);
  return by_rows.logical_or(by_columns).logical_or(unknown);
}

at::Tensor CyclicReduction::rows_of(const at::Tensor& b) const {
  return coefficients_.size(0) == 1 ? b.reshape({1, -1, n_}) : b;
}

at::Tensor CyclicReduction::reduce(const at::Tensor& b) const {
  const int64_t m = n_ - 1;
  // One row after the other: what couples each point to those before and behind, then right-hand sides; all over the
  // diagonal.
  auto rows = at::cat({lower_.unsqueeze(1), upper_.unsqueeze(1), column_.unsqueeze(1), b.narrow(-1, 0, m)}, 1) /
              pivot_.unsqueeze(1);
  constexpr int64_t kBefore = 0, kBehind = 1, kSides = 2;
  const auto part = [](const at::Tensor& t, int64_t row) { return t.narrow(1, row, 1); };
  const auto sides = [](const at::Tensor& t) { return t.narrow(1, kSides, t.size(1) - kSides); };
  for (int64_t step = 1; step < m; step *= 2) {
    const auto before = part(rows, kBefore) * padded(rows.narrow(2, 0, m - step), step, 0);
    const auto behind = part(rows, kBehind) * padded(rows.narrow(2, step, m - step), 0, step);
    const auto diagonal = 1.0 - part(before, kBehind) - part(behind, kBefore);
    const auto left = sides(rows) - sides(before) - sides(behind);
    rows = at::cat({-part(before, kBefore), -part(behind, kBehind), left}, 1) / diagonal;
  }
  return sides(rows);
}

at::Tensor CyclicReduction::solve(const at::Tensor& b) const {
  if (n_ == 1) return b / coefficients_.sum(1, /*keepdim=*/true);
  const auto rows = rows_of(b), reduced = reduce(rows);
  const auto column = reduced.narrow(1, 0, 1), v = reduced.narrow(1, 1, rows.size(1));
  const auto border_product = [&](const at::Tensor& t) { return (border_.unsqueeze(1) * t).sum(2, /*keepdim=*/true); };
  const auto corner = corner_.unsqueeze(1), taken_off = border_product(column), pivot = corner - taken_off;
  const double rounding = epsilon_of(coefficients_) * static_cast<double>(n_);
  const auto regular = pivot.abs().gt((corner.abs() + taken_off.abs()) * rounding);
  const auto last = (rows.narrow(2, n_ - 1, 1) - border_product(v)) / pivot.masked_fill(regular.logical_not(), NAN);
  return at::cat({at::addcmul(v, column, last, -1), last}, 2).view_as(b);
}

at::Tensor CyclicReduction::solve_with_constant(const at::Tensor& b) const {
  if (n_ == 1) return at::zeros_like(b);
  // The last equation follows from the others, and the last unknown is free.
  const auto rows = rows_of(b - b.mean(2, /*keepdim=*/true));
  const auto u = padded(reduce(rows).narrow(1, 1, rows.size(1)), 0, 1);
  return (u - u.mean(2, /*keepdim=*/true)).view_as(b);
}

}  // namespace prdp
