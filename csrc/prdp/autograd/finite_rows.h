#pragma once
#include <ATen/ATen.h>

#include <algorithm>
#include <vector>

/// Sets of samples of a batch, and sums over them if some are not finite.
namespace prdp {

using Rows = std::vector<bool>;  // which samples

inline bool any(const Rows& rows) { return std::find(rows.begin(), rows.end(), true) != rows.end(); }
inline bool all(const Rows& rows) { return std::find(rows.begin(), rows.end(), false) == rows.end(); }

/// The samples that are in both, in either, and those of `rows` that are not in `others`.
inline Rows both(Rows rows, const Rows& others) {
  for (size_t i = 0; i < rows.size(); ++i) rows[i] = rows[i] && others[i];
  return rows;
}
inline Rows either(Rows rows, const Rows& others) {
  for (size_t i = 0; i < rows.size(); ++i) rows[i] = rows[i] || others[i];
  return rows;
}
inline Rows except(Rows rows, const Rows& others) {
  for (size_t i = 0; i < rows.size(); ++i) rows[i] = rows[i] && !others[i];
  return rows;
}

/// t with zeros in all samples except these, even if they were not finite; differentiable.
at::Tensor only(const at::Tensor& t, const Rows& rows);
/// The samples without NaN and Inf.
Rows finite_rows(const at::Tensor& t);
bool all_finite(const std::vector<at::Tensor>& tensors);

/// Zeros where `of_none`, the share of no sample, is not finite.
void clear_where_not_finite(std::vector<at::Tensor>& tensors, const std::vector<at::Tensor>& of_none);

/// share(rows), a vector of tensors, is a sum over these samples. If it is not finite, the samples that cause this are
/// removed from `rows`. The others keep their shares, unaffected by numbers outside the range of the dtype. Where even
/// the share of no sample is not finite, as of an A that holds a NaN in another sample, the sum is zero.
template <class Share>
std::vector<at::Tensor> finite_sum(Rows& rows, const Share& share) {
  auto sum = share(rows);
  if (all_finite(sum)) return sum;
  const auto of_none = share(Rows(rows.size(), false));
  const auto finite_share = [&](const Rows& some) {
    auto found = share(some);
    clear_where_not_finite(found, of_none);
    return found;
  };
  const auto before = rows;
  for (size_t i = 0; i < rows.size(); ++i) {
    Rows alone(rows.size(), false);
    alone[i] = true;
    if (before[i]) rows[i] = all_finite(finite_share(alone));
  }
  sum = finite_share(rows);
  if (all_finite(sum)) return sum;
  rows.assign(rows.size(), false);  // each is finite and their sum is not
  for (auto& t : sum)
    if (t.defined()) t = at::zeros_like(t);
  return sum;
}

}  // namespace prdp
