#include "prdp/gpu/device/diffusion_product_rule.h"
#include "prdp/operators/broadcast_sums.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/product_rule_kernels.h"

/// The product rule of a Diffusion in one launch on a GPU.
namespace prdp {

namespace {

/// As the kernel counts axes.
int64_t axis_of_kernel(int64_t axis, int64_t dim) { return axis + 3 - dim; }

template <class T>
gpu::SideField<T> side_field(const at::Tensor& h) {
  if (h.dim() == 0 && h.is_cpu()) return {nullptr, 0, 0, h.item<T>()};
  if (h.dim() == 0) return {h.const_data_ptr<T>(), 0, 0, T(0)};
  return {h.const_data_ptr<T>(), h.size(0) == 1 ? 0 : h.stride(0), 1, T(0)};
}

/// A side whose h gets a derivative.
struct RobinSide {
  int64_t axis, number;  // the latter as the kernel counts sides
  size_t sum;            // its index among all sums
  at::Tensor h;          // as the kernel reads it
};

}  // namespace

template <class T>
std::vector<at::Tensor> DiffusionOperator::launch_product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  const auto kappa = kappa_.detach().contiguous(), l = lambda.contiguous(), v = u.contiguous();
  const auto kappa_bar = at::empty_like(kappa);
  gpu::DiffusionProductRule<T> rule{};
  rule.pair = pair_of<T>(l, v, kappa.size(0));
  rule.batch = static_cast<int>(l.size(0));
  rule.kappas = static_cast<int>(kappa.size(1));
  rule.harmonic = box_.mean == FaceMean::kHarmonic;
  rule.kappa = kappa.const_data_ptr<T>();
  rule.kappa_out = kappa_bar.mutable_data_ptr<T>();
  for (int64_t axis = 0; axis < 3; ++axis) {
    const int64_t d = axis - axis_of_kernel(0, dim());
    rule.n[axis] = d < 0 ? 1 : static_cast<int>(shape_[d]);
    rule.inverse_width[axis] = d < 0 ? 0.0 : inverse_width(d);
    for (int64_t end = 0; end < 2; ++end)
      rule.sides[2 * axis + end] = static_cast<int>(d < 0 ? Side::kFlux : box_.sides[d][end]);
  }
  BroadcastSums sums(l);
  const size_t shift_sum = sums.size();
  rule.sums[0] = sums.add(shift_);
  std::vector<RobinSide> robin_sides;
  for (int64_t axis = 0; axis < dim(); ++axis)
    for (size_t end = 0; end < 2; ++end) {
      if (box_.sides[axis][end] != Side::kRobin) continue;
      const int64_t number = 2 * axis_of_kernel(axis, dim()) + static_cast<int64_t>(end);
      robin_sides.push_back({axis, number, sums.size(), robin(axis, end).detach().contiguous()});
      rule.robin[number] = side_field<T>(robin_sides.back().h);
      rule.sums[1 + number] = sums.add(robin(axis, end), axis);
    }
  rule.sums_out[0] = sums.memory(shift_sum);
  for (const auto& side : robin_sides) rule.sums_out[1 + side.number] = sums.memory(side.sum);
  const int64_t count = kappa_bar.numel() + sums.count();
  if (!gpu::each_point(l.device(),
                       product_rule_body<T>("DiffusionProductRule", "prdp/gpu/device/diffusion_product_rule.h"), rule,
                       count))
    return {};
  const auto of_shift = sums.result(shift_sum);
  std::vector<at::Tensor> found{per_axis_ ? kappa_bar : kappa_bar.squeeze(1),
                                shift_.dim() == 0 ? of_shift : of_shift.squeeze(1)};
  for (const auto& side : robin_sides) {
    const auto bar = sums.result(side.sum);
    found.push_back(bar.dim() == 0 ? bar : bar.squeeze(2 + side.axis).squeeze(1));
  }
  return found;
}

std::vector<at::Tensor> DiffusionOperator::product_rule_by_kernel(const at::Tensor& lambda, const at::Tensor& u) const {
  if (!has_product_rule_kernel(lambda, u)) return {};
  return u.scalar_type() == at::kFloat ? launch_product_rule<float>(lambda, u) : launch_product_rule<double>(lambda, u);
}

}  // namespace prdp
