#include <ATen/ExpandUtils.h>

#include <algorithm>

#include "prdp/gpu/device/flow_back.h"
#include "prdp/operators/broadcast_sums.h"
#include "prdp/steppers/flow/kernel_fields.h"

namespace prdp::flow_kernels {

namespace {

using Tensor = FlowEquation::Tensor;

/// Where u and the tensors of the equation are in what is found and wanted: u first.
constexpr size_t kState = 0;
constexpr size_t place_of(size_t tensor) { return tensor + 1; }

/// The cotangents on the faces at one end of an axis; summed afterwards where samples or faces share the given value.
struct End {
  size_t place;
  int64_t axis;
  bool high;
  at::Tensor bar;
};

/// The inflow comes in through the open axis; each wall is at an end of its own.
std::vector<End> ends_of(const FlowBox& box, const at::Tensor& like, const std::vector<bool>& wanted) {
  constexpr size_t inflow = place_of(Tensor::kInflow), walls = place_of(Tensor::kFirstWall);
  std::vector<End> ends;
  for (size_t i = inflow; i < wanted.size(); ++i) {
    if (!wanted[i]) continue;
    const int64_t axis = i == inflow ? box.open_axis() : static_cast<int64_t>(i - walls) / 2;
    auto sizes = like.sizes().vec();
    sizes[axis + 2] = 1;
    ends.push_back({i, axis, i > inflow && (i - walls) % 2 != 0, at::empty(sizes, like.options())});
  }
  return ends;
}

/// The sum over the products that a tensor of the equation is part of; nothing, if its gradient is not wanted.
struct WantedSum {
  gpu::BroadcastSum terms{};
  std::optional<size_t> index{};  // among all sums
};
WantedSum add_if(bool wanted, BroadcastSums& sums, const at::Tensor& of) {
  if (!wanted) return {};
  const size_t index = sums.size();
  return {sums.add(of), index};
}

template <class T>
gpu::FlowEndBars<T> end_bars_of(const FlowBox& box, const End& end) {
  const bool is_inflow = box.boundary(end.axis) == FlowBoundary::kOpen;
  gpu::FlowEndBars<T> of{.inlet = field_of<const T>(is_inflow ? box.fields(end.bar.options()).inlet : at::Tensor()),
                         .axis = static_cast<int>(end.axis + 3 - box.dim()),
                         .high = end.high,
                         .reflects = {},
                         .out = field_of<T>(end.bar),
                         .count = static_cast<int>(end.bar.numel())};
  for (int64_t other = 0; other < box.dim(); ++other)  // with_ghosts() makes the open axis' ghosts first
    of.reflects[other + 3 - box.dim()] =
        is_inflow ? other != end.axis : other > end.axis && box.boundary(other) != FlowBoundary::kOpen;
  return of;
}

template <class T>
gpu::FlowViscosityBars<T> viscosity_bars_of(const FlowBox& box, const ImplicitPart& part) {
  gpu::FlowViscosityBars<T> of{.diffused = field_of<const T>(part.diffused),
                               .lambda = field_of<const T>(part.lambda),
                               .patterns = {},
                               .sample = 0,
                               .change = field_of<const T>(part.change),
                               .balanced = field_of<const T>(part.potential.defined() ? part.balanced : at::Tensor()),
                               .potential = field_of<const T>(part.potential),
                               .potential_bar = field_of<const T>(part.potential_bar),
                               .largest_nu = number_of(part.largest_nu)};
  if (part.diffused.empty()) return of;
  const auto& patterns = box.fields(part.change.options()).diffusion;
  of.sample = step_of_samples(patterns[0]);
  for (size_t c = 0; c < static_cast<size_t>(box.dim()); ++c)
    of.patterns[c] = data_of<const T>(patterns[std::min(c, patterns.size() - 1)]);
  return of;
}

}  // namespace

std::optional<std::vector<at::Tensor>> explicit_vjp(const FlowEquation& equation, const PaddedVelocity& start,
                                                    const at::Tensor& velocity_bar, const FlowParts& change_bar,
                                                    const ImplicitPart& part, at::IntArrayRef needed) {
  const auto& box = *equation.box;
  const auto& like = start.velocity;
  const auto given = equation.tensors();
  std::vector<at::Tensor> found(given.size() + 1);
  std::vector<bool> wanted(found.size());
  for (size_t i = 0; i < found.size(); ++i) wanted[i] = needed[i] && (i == 0 || given[i - 1].defined());
  if (wanted[kState]) found[kState] = by_channels(like, box);
  const auto ends = ends_of(box, like, wanted);
  BroadcastSums sums(like);
  const auto nu = add_if(wanted[place_of(Tensor::kNu)], sums, equation.nu);
  const auto force = add_if(wanted[place_of(Tensor::kForce)], sums, equation.force);
  int64_t count = sums.count() + (wanted[kState] ? found[kState].numel() : 0);
  for (const auto& end : ends) count += end.bar.numel();
  if (count == 0) return found;
  const bool launched = each_point({"FlowBars", "prdp/gpu/device/flow_back.h"}, like, count, [&]<class T>(T) {
    gpu::FlowBars<T> of{.state = {{terms_of<T>(equation, start.padded), field_of<const T>(change_bar)},
                                  field_of<const T>(velocity_bar),
                                  field_of<T>(found[kState])},
                        .of_state = static_cast<int>(wanted[kState] ? found[kState].numel() : 0),
                        .ends = static_cast<int>(ends.size()),
                        .end = {},
                        .force = force.terms,
                        .of_nu = nu.terms,
                        .nu = viscosity_bars_of<T>(box, part),
                        .force_out = force.index ? sums.memory(*force.index) : nullptr,
                        .nu_out = nu.index ? sums.memory(*nu.index) : nullptr};
    for (size_t k = 0; k < ends.size(); ++k) of.end[k] = end_bars_of<T>(box, ends[k]);
    return of;
  });
  if (!launched) return std::nullopt;
  if (nu.index) found[place_of(Tensor::kNu)] = sums.result(*nu.index);
  if (force.index) found[place_of(Tensor::kForce)] = sums.result(*force.index);
  for (const auto& end : ends) found[end.place] = at::sum_to(end.bar, given[end.place - 1].sizes());
  return found;
}

}  // namespace prdp::flow_kernels
