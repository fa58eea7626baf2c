#pragma once
#include <ATen/ATen.h>

#include <algorithm>
#include <vector>

/// Samples of a batch, and what becomes of a sum over them where one is not finite.
namespace prdp {

using Rows = std::vector<bool>;  // which samples

inline bool any(const Rows& rows) { return std::find(rows.begin(), rows.end(), true) != rows.end(); }
inline bool all(const Rows& rows) { return std::find(rows.begin(), rows.end(), false) == rows.end(); }
inline Rows both(Rows a, const Rows& b) {
  for (size_t i = 0; i < a.size(); ++i) a[i] = a[i] && b[i];
  return a;
}

/// t with zeros, whatever was there, in all samples but these; differentiable.
at::Tensor only(const at::Tensor& t, const Rows& rows);
/// Which samples hold neither NaN nor Inf.
Rows finite_rows(const at::Tensor& t);
bool all_finite(const std::vector<at::Tensor>& tensors);

/// share(rows), a vector of tensors, sums over these samples. Where it is not finite, the samples to blame
/// leave `rows`, and the others keep what they have: no number that left the range of the dtype reaches them.
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
