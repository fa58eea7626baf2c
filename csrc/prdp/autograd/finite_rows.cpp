#include "prdp/autograd/finite_rows.h"

#include <algorithm>

#include "prdp/kernels/vector.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// Calls body(values, count) with the tensor's numbers on the host, as float or double; complex ones are two each.
template <class Body>
auto with_numbers(const at::Tensor& t, const Body& body) {
  auto host = t.detach().to(at::kCPU).contiguous();
  if (host.is_complex()) host = at::view_as_real(host.resolve_conj());
  if (host.scalar_type() == at::kFloat) return body(host.const_data_ptr<float>(), host.numel());
  host = host.to(at::kDouble);
  return body(host.const_data_ptr<double>(), host.numel());
}

}  // namespace

at::Tensor only(const at::Tensor& t, const Rows& rows) {
  if (all(rows)) return t;
  auto others = at::empty({static_cast<int64_t>(rows.size())}, at::kBool);
  for (size_t i = 0; i < rows.size(); ++i) others.mutable_data_ptr<bool>()[i] = !rows[i];
  return cleared(t, others.to(t.device()));
}

Rows finite_rows(const at::Tensor& t) {
  if (!t.is_cpu()) {
    const auto rows = t.detach().isfinite().flatten(1).all(1).to(at::kCPU);
    return Rows(rows.const_data_ptr<bool>(), rows.const_data_ptr<bool>() + rows.numel());
  }
  return with_numbers(t, [&](const auto* values, int64_t count) {
    Rows rows(t.size(0));
    const int64_t each = count / std::max<int64_t>(t.size(0), 1);
    for (size_t i = 0; i < rows.size(); ++i)
      rows[i] = std::isfinite(kernels::largest_magnitude(values + static_cast<int64_t>(i) * each, each));
    return rows;
  });
}

bool all_finite(const std::vector<at::Tensor>& tensors) {
  std::vector<at::Tensor> elsewhere;  // flags, which one copy tells
  for (const auto& t : tensors)
    if (t.defined() && !t.is_cpu()) elsewhere.push_back(t.detach().isfinite().all());
  if (!elsewhere.empty() && !at::stack(elsewhere).all().item<bool>()) return false;
  return std::all_of(tensors.begin(), tensors.end(), [](const at::Tensor& t) {
    return !t.defined() || !t.is_cpu() || with_numbers(t, [](const auto* values, int64_t count) {
      return std::isfinite(kernels::largest_magnitude(values, count));
    });
  });
}

void clear_where_not_finite(std::vector<at::Tensor>& tensors, const std::vector<at::Tensor>& of_none) {
  for (size_t i = 0; i < tensors.size(); ++i)
    if (tensors[i].defined() && of_none[i].defined())
      tensors[i] = tensors[i].masked_fill(of_none[i].isfinite().logical_not(), 0.0);
}

}  // namespace prdp
