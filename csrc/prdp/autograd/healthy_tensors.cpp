#include "prdp/autograd/healthy_tensors.h"

#include "prdp/operators/kinds.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/solver.h"

namespace prdp {

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

namespace {
/// Whether it is known which tensors the samples share. Of a Function, one whose first extent is that of the batch may
/// be shared.
bool knows_axes(const OperatorSpec& a) {
  return batched_axes(a.kind, static_cast<int64_t>(a.shape.size()), a.tensors.size()).has_value();
}
}  // namespace

Rows has_finite_tensors(const OperatorSpec& a, int64_t batch) {
  Rows rows(batch, true);
  for (size_t k = 0; k < a.tensors.size(); ++k) {
    if (!is_of_samples(a, k, batch)) continue;
    const auto finite = finite_rows(a.tensors[k].reshape({batch, -1}));
    for (int64_t i = 0; i < batch; ++i) rows[i] = rows[i] && finite[i];
  }
  return rows;
}

at::Tensor with_healthy_rows(const at::Tensor& t, const Rows& healthy) {
  if (!t.defined() || all(healthy) || !any(healthy)) return t;
  const int64_t first = std::find(healthy.begin(), healthy.end(), true) - healthy.begin();
  std::vector<int64_t> from(healthy.size());
  for (size_t i = 0; i < from.size(); ++i) from[i] = healthy[i] ? static_cast<int64_t>(i) : first;
  return t.index_select(0, at::tensor(from, at::kLong).to(t.device()));
}

OperatorSpec with_healthy_tensors(OperatorSpec a, const Rows& take_part) {
  const auto batch = static_cast<int64_t>(take_part.size());
  if (all(take_part)) return a;
  for (size_t k = 0; k < a.tensors.size(); ++k) {
    if (!is_of_samples(a, k, batch)) continue;
    auto healthy = take_part;
    if (!knows_axes(a)) healthy = either(healthy, finite_rows(a.tensors[k].reshape({batch, -1})));  // it may be shared
    a.tensors[k] = with_healthy_rows(a.tensors[k], healthy);
  }
  return a;
}

OperatorSpec with_ones_where_refused(OperatorSpec a, const at::Tensor& status) {
  if (!knows_axes(a)) return a;
  const auto refused = is_refused(status);
  const size_t bases = is_singular(a) ? 2 : 0;  // of null spaces: ones would depend on each other
  for (size_t k = 0; k + bases < a.tensors.size(); ++k)
    if (auto& t = a.tensors[k]; t.is_floating_point() && is_of_samples(a, k, status.size(0)))
      t = t.masked_fill(per_sample(refused, t).to(t.device()), 1.0);
  return a;
}

}  // namespace prdp
