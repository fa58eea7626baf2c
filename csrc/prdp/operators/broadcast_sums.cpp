#include "prdp/operators/broadcast_sums.h"

#include <ATen/Parallel.h>

#include <algorithm>

#include "prdp/operators/sums_in_order.h"

namespace prdp {

namespace {

/// Of a sum of so many terms: a thread takes one.
int64_t parts_of(int64_t terms, int64_t entries) {
  constexpr int64_t most_of_thread = 1024, least_of_thread = 16, worthwhile = 16384;
  if (terms <= most_of_thread) return 1;
  return std::min(at::divup(terms, least_of_thread), std::max<int64_t>(1, worthwhile / entries));
}

}  // namespace

gpu::BroadcastSum BroadcastSums::add(const at::Tensor& of, int64_t across) {
  gpu::BroadcastSum sum{{1, 1, 1, 1, 1}, {}, 1, 0};
  int64_t entries = 1, terms = 1;
  for (int64_t axis = 0; axis < like_.dim(); ++axis) {
    const int64_t n = axis == 2 + across && across >= 0 ? 1 : like_.size(axis);
    const bool own = of.dim() > 0 && of.size(axis) == n;
    const auto place = axis < 2 ? axis : axis + gpu::BroadcastSum::kAxes - like_.dim();
    sum.n[place] = static_cast<int>(n);
    sum.own[place] = own;
    (own ? entries : terms) *= n;
  }
  const int64_t parts = parts_of(terms, entries);
  sum.parts = static_cast<int>(parts);
  sum.count = static_cast<int>(entries * parts);
  sums_.push_back({of.sizes().vec(), count_, parts, entries * parts});
  count_ += entries * parts;
  return sum;
}

double* BroadcastSums::memory(size_t k) {
  if (!memory_.defined()) memory_ = at::empty({count_}, like_.options().dtype(at::kDouble));
  return memory_.mutable_data_ptr<double>() + sums_[k].first;
}

at::Tensor BroadcastSums::result(size_t k) const {
  const auto& of = sums_[k];
  auto sum = memory_.narrow(0, of.first, of.count).view({-1, of.parts});
  if (of.parts > 1) sum = sum_in_order(sum, {-1});
  return sum.to(like_.scalar_type()).view(of.sizes);
}

}  // namespace prdp
