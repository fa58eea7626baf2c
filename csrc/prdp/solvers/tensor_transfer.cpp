#include "prdp/solvers/tensor_transfer.h"

#include <utility>

#include "prdp/kernels/coarsening.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// Along one axis, the coefficients with offset -1, 0 and 1; undefined where there are none.
struct Row {
  at::Tensor before, own, after;
  at::Tensor& at(int64_t offset) { return offset < 0 ? before : offset > 0 ? after : own; }
};

/// The sums of the coefficients that reach as far along the axis.
Row sums_along(const TensorStencil& a, int64_t axis) {
  const auto zero = at::zeros_like(a.diagonal());
  Row sums{zero, zero, zero};
  for (const auto& [offset, coefficient] : a.entries) add_to(sums.at(offset[axis]), coefficient);
  return sums;
}

/// The rows along the axis, by the offsets along the others; none of them first.
std::vector<std::pair<std::vector<int64_t>, Row>> rows_along(const TensorStencil& a, int64_t axis) {
  std::vector<std::pair<std::vector<int64_t>, Row>> rows;
  for (const auto& [offset, coefficient] : a.entries) {
    auto others = offset;
    others[axis] = 0;
    auto row = std::find_if(rows.begin(), rows.end(), [&](const auto& other) { return other.first == others; });
    if (row == rows.end()) row = rows.insert(rows.end(), {others, {}});
    row->second.at(offset[axis]) = coefficient;
  }
  return rows;
}

}  // namespace

TensorTransfer::TensorTransfer(const TensorStencil& a, const TensorStencil& transpose, int64_t axis)
    : axis_(axis - a.dim()),
      fine_(a.shape[axis]),
      coarse_(kernels::coarse_points(fine_, a.periodic[axis])),
      between_(fine_ - coarse_),
      periodic_(a.periodic[axis]) {
  const auto places = at::arange(fine_, a.diagonal().options().dtype(at::kLong));
  const auto is_coarse = places.remainder(2).eq(periodic_ ? 0 : 1), pairs = places.div(2, "floor");
  order_ = at::where(is_coarse, pairs, coarse_ + pairs);
  const auto own = sums_along(a, axis), other = sums_along(transpose, axis);
  // As weights_of() in kernels/galerkin.cpp.
  const auto sign = at::where(at_between(a.diagonal()).lt(0), -1.0, 1.0).to(a.diagonal().scalar_type());
  const auto weights = [&](const Row& sums) {
    const auto before = (-sign * at_between(sums.before)).clamp_min(0.0);
    const auto after = (-sign * at_between(sums.after)).clamp_min(0.0);
    const auto whole = at::maximum(sign * at_between(sums.own), before + after);
    const auto share = at::where(whole.gt(0), whole, 1.0).reciprocal();
    return Weights{before * share, after * share};
  };
  interpolation_ = weights({own.before + other.before, own.own + other.own, own.after + other.after});
  restriction_ = weights(other);
}

at::Tensor TensorTransfer::after_coarse(const at::Tensor& between, double without) const {
  const auto own = periodic_ ? between : between.narrow(axis_, 1, between_ - 1);
  if (own.size(axis_) == coarse_) return own;
  return at::cat({own, at::full_like(between.narrow(axis_, 0, 1), without)}, axis_);
}

at::Tensor TensorTransfer::before_coarse(const at::Tensor& between, double without) const {
  if (!periodic_) return between.narrow(axis_, 0, coarse_);
  if (between_ == coarse_) return between.roll(1, axis_);
  return at::cat({at::full_like(between.narrow(axis_, 0, 1), without), between}, axis_);
}

at::Tensor TensorTransfer::interpolate(const at::Tensor& coarse, bool transposed) const {
  const auto& w = transposed ? restriction_ : interpolation_;
  const auto none = periodic_ ? at::Tensor() : at::zeros_like(coarse.narrow(axis_, 0, 1));
  const auto before = periodic_ ? coarse : at::cat({none, coarse}, axis_);
  const auto after = periodic_ ? coarse.roll(-1, axis_) : at::cat({coarse, none}, axis_);
  const auto made = at::addcmul(w.before.unsqueeze(1) * before.narrow(axis_, 0, between_), w.after.unsqueeze(1),
                                after.narrow(axis_, 0, between_));
  return at::cat({coarse, made}, axis_).index_select(axis_, order_);
}

at::Tensor TensorTransfer::restrict(const at::Tensor& fine, bool transposed) const {
  const auto& w = transposed ? interpolation_ : restriction_;
  const auto between = at_between(fine);
  return at_coarse(fine) + after_coarse(w.before.unsqueeze(1) * between) +
         before_coarse(w.after.unsqueeze(1) * between);
}

TensorStencil TensorTransfer::coarse_operator(const TensorStencil& a) const {
  const int64_t axis = axis_ + a.dim();
  TensorStencil made{a.shape, a.periodic, {}};
  made.shape[axis] = coarse_;
  const bool is_pair = coarse_ == 2;  // whose points are each other's neighbour on both sides
  if (is_pair) made.periodic[axis] = true;
  for (auto& [others, row] : rows_along(a, axis)) {
    // A P: what the fine points take from the coarse ones, whose weights are those where the other axes lead.
    const Weights p{neighbours(interpolation_.before, a, others), neighbours(interpolation_.after, a, others)};
    Row coarse, between;
    const auto add_coarse = [&](at::Tensor& sum, const at::Tensor& coefficient, const at::Tensor& weight) {
      if (coefficient.defined()) add_to(sum, at_coarse(coefficient) * weight);
    };
    if (row.own.defined()) {
      coarse.own = at_coarse(row.own);
      between.before = at_between(row.own) * p.before;
      between.after = at_between(row.own) * p.after;
    }
    add_coarse(coarse.own, row.after, after_coarse(p.before, 0.0));
    add_coarse(coarse.after, row.after, after_coarse(p.after, 1.0));
    add_coarse(coarse.own, row.before, before_coarse(p.after, 0.0));
    add_coarse(coarse.before, row.before, before_coarse(p.before, 1.0));
    if (row.before.defined()) add_to(between.before, at_between(row.before));
    if (row.after.defined()) add_to(between.after, at_between(row.after));
    // R A P: what the points between hand on to the coarse point before them, and to the one after.
    if (between.before.defined()) {
      add_to(coarse.own, after_coarse(restriction_.before * between.before));
      add_to(coarse.before, before_coarse(restriction_.after * between.before));
    }
    if (between.after.defined()) {
      add_to(coarse.after, after_coarse(restriction_.before * between.after));
      add_to(coarse.own, before_coarse(restriction_.after * between.after));
    }
    if (is_pair) add_to(coarse.after, std::exchange(coarse.before, {}));
    if (coarse_ == 1 && periodic_)  // and is its own neighbour
      for (const auto& around : {coarse.before, coarse.after}) add_to(coarse.own, around);
    if (coarse_ == 1) coarse.before = coarse.after = at::Tensor();
    for (const int64_t offset : {0, 1, -1}) {
      auto there = others;
      there[axis] = offset;
      if (coarse.at(offset).defined()) made.entries.push_back({there, coarse.at(offset)});
    }
  }
  return made;
}

}  // namespace prdp
