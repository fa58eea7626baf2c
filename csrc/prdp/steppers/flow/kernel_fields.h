#pragma once
#include <ATen/Dispatch.h>

#include "prdp/gpu/device/flow.h"
#include "prdp/gpu/launch.h"
#include "prdp/gpu/operator_view.h"
#include "prdp/steppers/flow/kernels.h"

/// Tensors of a flow as its kernels take them.
namespace prdp::flow_kernels {

inline gpu::FlowGrid grid_of(const FlowBox& box) {
  static_assert(static_cast<int>(FlowBoundary::kPeriodic) == gpu::kPeriodicEnds &&
                static_cast<int>(FlowBoundary::kWall) == gpu::kWallEnds &&
                static_cast<int>(FlowBoundary::kOpen) == gpu::kOpenEnds &&
                static_cast<int>(FlowBoundary::kSlip) == gpu::kSlipEnds);
  gpu::FlowGrid grid{static_cast<int>(box.dim()), {1, 1, 1}, {}, {1, 1, 1}};
  for (int64_t axis = 0; axis < box.dim(); ++axis) {
    const int64_t a = axis + 3 - box.dim();
    grid.n[a] = static_cast<int>(box.shape()[axis]);
    grid.ends[a] = static_cast<int>(box.boundary(axis));
    grid.dx[a] = box.dx(axis);
  }
  return grid;
}

/// The numbers of t; null if it is undefined.
template <class T>
T* data_of(const at::Tensor& t) {
  if (!t.defined()) return nullptr;
  if constexpr (std::is_const_v<T>) return t.const_data_ptr<std::remove_const_t<T>>();
  else return t.mutable_data_ptr<T>();
}

/// A field (batch or 1, d or 1, *shape or 1) with any strides.
template <class T>
gpu::FlowField<T> field_of(const at::Tensor& t) {
  gpu::FlowField<T> field{};
  if (!t.defined()) return field;
  const auto step = [&](int64_t axis) { return t.size(axis) == 1 ? 0 : t.stride(axis); };
  for (int64_t c = 0; c < 3; ++c) field.of[c] = data_of<T>(t) + (c < t.size(1) ? c : 0) * step(1);
  field.sample = step(0);
  for (int64_t axis = 2; axis < t.dim(); ++axis) field.step[axis + 3 - t.dim()] = static_cast<int>(step(axis));
  return field;
}
template <class T>
gpu::FlowField<T> field_of(const FlowParts& parts) {
  if (parts.size() <= 1) return field_of<T>(parts.empty() ? at::Tensor() : parts[0]);
  auto field = field_of<T>(parts[0]);
  for (size_t c = 1; c < parts.size(); ++c) {
    TORCH_INTERNAL_ASSERT(parts[c].strides() == parts[0].strides() || parts[c].size(0) == 1);
    field.of[c] = data_of<T>(parts[c]);
  }
  return field;
}

/// Entries between two samples of a contiguous tensor; 0: they share it.
inline int64_t step_of_samples(const at::Tensor& t) { return t.size(0) > 1 ? t.stride(0) : 0; }

/// A tensor without axes, which may be on the host: nobody waits for it; or (batch or 1, 1, …). Undefined: 0.
template <class T>
gpu::FlowNumber<T> number_of(const at::Tensor& t) {
  if (t.defined() && t.dim() == 0 && t.is_cpu()) return {nullptr, 0, t.item<T>()};
  return {data_of<const T>(t), t.defined() && t.numel() > 1 ? t.stride(0) : 0, T(0)};
}

inline gpu::FlowNumber<double> number_of(const LargestViscosity& limit) {
  return limit.of_each.defined() ? number_of<double>(limit.of_each) : gpu::FlowNumber<double>{nullptr, 0, limit.of_all};
}

template <class T>
gpu::FlowTerms<T> terms_of(const FlowEquation& e, const at::Tensor& padded) {
  const auto& fields = e.box->fields(padded.options());
  return {.grid = grid_of(*e.box),
          .padded = data_of<const T>(padded),
          .nu = number_of<T>(e.nu),
          .upwind = e.advection == FlowAdvection::kUpwind,
          .dt = e.dt,
          .free = field_of<const T>(fields.free),
          .friction = field_of<const T>(fields.friction)};
}

/// A new velocity whose channels lie behind each other, each that of all samples: a solve takes one without a copy.
inline at::Tensor by_channels(const at::Tensor& like, const FlowBox& box) {
  auto sizes = box.shape();
  sizes.insert(sizes.begin(), {box.dim(), like.size(0)});
  return at::empty(sizes, like.options()).transpose(0, 1);
}

/// The sizes of a field with one channel.
inline std::vector<int64_t> sizes_of_potential(const at::Tensor& like, const FlowBox& box) {
  auto sizes = box.shape();
  sizes.insert(sizes.begin(), {like.size(0), 1});
  return sizes;
}

inline int64_t cells_of(const FlowBox& box) { return c10::multiply_integers(box.shape()); }

/// A loop over points or samples: the name of its struct, and the header of gpu/device that has it.
struct Loop {
  const char *name, *header;
  gpu::Body body(const at::Tensor& like) const {
    return {std::string(name) + "<" + gpu::type_of(like.scalar_type()) + ">", header};
  }
};

/// Whether the loop was launched for `count` points, in the dtype of `like`; make(T{}) is its struct.
template <class Make>
bool each_point(const Loop& loop, const at::Tensor& like, int64_t count, const Make& make) {
  return AT_DISPATCH_FLOATING_TYPES(like.scalar_type(), "flow_kernels", [&] {
    return gpu::each_point(like.device(), loop.body(like), make(scalar_t{}), count);
  });
}
/// The same for the samples of `like`, of so many points each.
template <class Make>
bool each_sample(const Loop& loop, const at::Tensor& like, int64_t points, const Make& make) {
  return AT_DISPATCH_FLOATING_TYPES(like.scalar_type(), "flow_kernels", [&] {
    return gpu::each_sample(like.device(), loop.body(like), make(scalar_t{}), points, like.size(0));
  });
}

}  // namespace prdp::flow_kernels
