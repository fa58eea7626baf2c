#include "prdp/autograd/healthy_tensors.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/kinds.h"
#include "prdp/operators/probes.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/status.h"

namespace prdp {

namespace {

Rows others_of(Rows rows) {
  rows.flip();
  return rows;
}

OperatorSpec with_rows_replaced(OperatorSpec a, const Rows& replaced) {
  for (size_t k = 0; k < a.tensors.size(); ++k)
    if (is_of_samples(a, k, static_cast<int64_t>(replaced.size())))
      a.tensors[k] = with_healthy_rows(a.tensors[k], replaced);
  return a;
}

/// Whether the products of these samples have the same bits.
bool are_the_same(const OperatorSpec& a, const OperatorSpec& other, const at::Tensor& b, const Rows& rows) {
  const at::NoGradGuard no_grad;
  const auto v = unstructured_like(b.detach());
  const auto product = [&](const OperatorSpec& of) { return only(make_operator(of)->apply(v), rows); };
  return at::equal(product(a), product(other));
}

}  // namespace

Rows not_refused(const at::Tensor& status) {
  const auto statuses = to_host<int64_t>(status, status.size(0));
  Rows rows(statuses.size());
  for (size_t i = 0; i < rows.size(); ++i) rows[i] = !is_refused(static_cast<SolveStatus>(statuses[i]));
  return rows;
}

bool is_of_samples(const OperatorSpec& a, size_t k, int64_t batch) {
  const auto& t = a.tensors[k];
  const auto axes = batched_axes(a.kind, static_cast<int64_t>(a.shape.size()), a.tensors.size());
  return t.layout() == at::kStrided && t.dim() > 0 && t.size(0) == batch && (!axes || (*axes)[k] == t.dim());
}

Rows has_finite_tensors(const OperatorSpec& a, int64_t batch) {
  Rows rows(batch, true);
  for (size_t k = 0; k < a.tensors.size(); ++k) {
    if (!is_of_samples(a, k, batch)) continue;
    const auto finite = finite_rows(a.tensors[k].reshape({batch, -1}));
    for (int64_t i = 0; i < batch; ++i) rows[i] = rows[i] && finite[i];
  }
  return rows;
}

at::Tensor with_healthy_rows(const at::Tensor& t, const Rows& replaced) {
  const int64_t healthy = std::find(replaced.begin(), replaced.end(), false) - replaced.begin();
  const auto batch = static_cast<int64_t>(replaced.size());
  if (!t.defined() || healthy == batch || !any(replaced)) return t;
  std::vector<int64_t> from(batch);
  for (int64_t i = 0; i < batch; ++i) from[i] = replaced[i] ? healthy : i;
  return t.index_select(0, at::tensor(from, at::kLong).to(t.device()));
}

OperatorSpec with_healthy_tensors(const OperatorSpec& a, const at::Tensor& b, const Rows& take_part) {
  if (all(take_part) || !any(take_part)) return a;
  auto healthy = with_rows_replaced(a, others_of(take_part));
  // A tensor that all samples share may happen to have as many rows as there are samples.
  if (!is_function(a) || are_the_same(a, healthy, b, take_part)) return healthy;
  auto replaced = others_of(take_part);
  const auto finite = has_finite_tensors(a, b.size(0));
  for (size_t i = 0; i < replaced.size(); ++i) replaced[i] = replaced[i] && !finite[i];
  return with_rows_replaced(a, replaced);
}

}  // namespace prdp
