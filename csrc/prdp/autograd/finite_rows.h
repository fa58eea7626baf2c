#pragma once
#include <ATen/ATen.h>

#include <algorithm>
#include <vector>

/// Sets of samples of a batch, and sums over them if some are not finite.
namespace prdp {

using Rows = std::vector<bool>;  // which samples

inline bool any(const Rows& rows) { return std::find(rows.begin(), rows.end(), true) != rows.end(); }
inline bool all(const Rows& rows) { return std::find(rows.begin(), rows.end(), false) == rows.end(); }
inline Rows both(Rows a, const Rows& b) {
  for (size_t i = 0; i < a.size(); ++i) a[i] = a[i] && b[i];
  return a;
}

/// t with zeros in all samples except these, even if they were not finite; differentiable.
at::Tensor only(const at::Tensor& t, const Rows& rows);
/// The samples without NaN and Inf.
Rows finite_rows(const at::Tensor& t);
bool all_finite(const std::vector<at::Tensor>& tensors);

/// share(rows), a vector of tensors, is a sum over these samples. If it is not finite, the samples that cause this are
/// removed from `rows`. The others keep their shares, unaffected by numbers outside the range of the dtype.
template <class Share>
std::vector<at::Tensor> finite_sum(Rows& rows, const Share& share) {
  auto sum = share(rows);
  if (all_finite(sum)) return sum;
  const auto before = rows;
  for (size_t i = 0; i < rows.size(); ++i) {
    Rows alone(rows.size(), false);
    alone[i] = true;
    if (before[i]) rows[i] = all_finite(share(alone));
  }
  sum = share(rows);
  if (all_finite(sum)) return sum;
  rows.assign(rows.size(), false);  // each is finite and their sum is not, or it is not even of none
  for (auto& t : sum)
    if (t.defined()) t = at::zeros_like(t);
  return sum;
}

}  // namespace prdp
