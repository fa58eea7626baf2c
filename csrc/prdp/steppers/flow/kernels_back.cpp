#include "prdp/gpu/device/flow_back.h"
#include "prdp/operators/shared_sums.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/kernel_fields.h"

namespace prdp::flow_kernels {

namespace {

constexpr const char* kBack = "prdp/gpu/device/flow_back.h";

/// What the reverse of the explicit part starts from.
struct Reverse {
  const FlowEquation& equation;
  const Start& start;
  const at::Tensor& velocity_bar;
  const FlowParts& change_bar;

  const FlowBox& box() const { return *equation.box; }
  const at::Tensor& like() const { return start.velocity; }
  int64_t batch() const { return like().size(0); }
  template <class T>
  gpu::FlowReverse<T> terms() const {
    return {terms_of<T>(equation, start.padded), field_of<const T>(change_bar)};
  }
  template <class T>
  gpu::FlowStateBars<T> state(const at::Tensor& u_bar) const {
    return {terms<T>(), field_of<const T>(velocity_bar), field_of<T>(u_bar)};
  }
};

at::Tensor of_state(const Reverse& r) {
  const auto out = by_channels(r.like(), r.box());
  const bool launched =
      each_point({"FlowStateBars", kBack}, out, out.numel(), [&]<class T>(T) { return r.state<T>(out); });
  return launched ? out : at::Tensor();
}

at::Tensor of_viscosity(const Reverse& r) {
  const auto sums = at::empty({r.batch()}, r.like().options().dtype(at::kDouble));
  const int64_t points = r.box().dim() * cells_of(r.box());
  const bool launched = each_sample({"FlowViscosityBars", kBack}, r.like(), points, [&]<class T>(T) {
    return gpu::FlowViscosityBars<T>{r.terms<T>(), data_of<double>(sums)};
  });
  return launched ? total(sums).to(r.like().scalar_type()) : at::Tensor();
}

/// Of the inflow, or of a wall: at an end of an axis, summed where samples or faces share it.
at::Tensor of_end(const Reverse& r, int64_t axis, bool high, const at::Tensor& given) {
  const auto& box = r.box();
  const bool is_inflow = box.boundary(axis) == FlowBoundary::kOpen;
  auto sizes = r.like().sizes().vec();
  sizes[axis + 2] = 1;
  const auto out = at::empty(sizes, r.like().options());
  const bool launched = each_point({"FlowEndBars", kBack}, out, out.numel(), [&]<class T>(T) {
    const auto& inlet = box.fields(out.options()).inlet;
    gpu::FlowEndBars<T> of{.state = r.state<T>({}),
                           .inlet = field_of<const T>(is_inflow ? inlet : at::Tensor()),
                           .axis = static_cast<int>(axis + 3 - box.dim()),
                           .high = high,
                           .fold = {},
                           .out = field_of<T>(out)};
    for (int64_t other = 0; other < box.dim(); ++other)  // with_ghosts() makes the open axis' ghosts first
      of.fold[other + 3 - box.dim()] =
          is_inflow ? other != axis : other > axis && box.boundary(other) != FlowBoundary::kOpen;
    return of;
  });
  return launched ? at::sum_to(out, given.sizes()) : at::Tensor();
}

at::Tensor of_force(const Reverse& r) {
  SharedSums sums(r.like());
  const auto sum = sums.add(r.equation.force);
  const bool launched = each_point({"FlowForceBars", kBack}, r.like(), sums.count(), [&]<class T>(T) {
    return gpu::FlowForceBars<T>{r.terms<T>(), sum, sums.memory(0)};
  });
  return launched ? sums.result(0) : at::Tensor();
}

}  // namespace

std::optional<std::vector<at::Tensor>> explicit_vjp(const FlowEquation& equation, const Start& start,
                                                    const at::Tensor& velocity_bar, const FlowParts& change_bar,
                                                    at::IntArrayRef needed) {
  const Reverse r{equation, start, velocity_bar, change_bar};
  const auto given = equation.tensors();
  std::vector<at::Tensor> found(given.size() + 1);
  for (size_t i = 0; i < found.size(); ++i) {
    if (!needed[i] || (i > 0 && !given[i - 1].defined())) continue;
    found[i] = i == 0   ? of_state(r)
               : i == 1 ? of_viscosity(r)
               : i == 2 ? of_force(r)
               : i == 3 ? of_end(r, equation.box->open_axis(), /*high=*/false, given[i - 1])
                        : of_end(r, static_cast<int64_t>(i - 4) / 2, (i - 4) % 2 != 0, given[i - 1]);
    if (!found[i].defined()) return std::nullopt;
  }
  return found;
}

}  // namespace prdp::flow_kernels
