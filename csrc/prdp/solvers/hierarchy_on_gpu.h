#pragma once
#include "prdp/gpu/operator_view.h"
#include "prdp/gpu/runtime.h"

namespace prdp::gpu {

/// Coarse grids are made by a kernel of their own, in one launch for all samples. It is compiled once for an operator,
/// whatever the methods.
struct HierarchyKernel {
  std::shared_ptr<const Kernel> kernel;
  OperatorView a;             // what the grids are made of
  int64_t blocks_of_team, numbers_of_sample, nullity;
  at::Tensor nullities;  // of each sample; undefined: that of all
};

/// Of this operator, for vectors like b, (batch, channel, *shape). Raises Unavailable.
HierarchyKernel hierarchy_kernel(Runtime& runtime, OperatorView a, const at::Tensor& b);

/// The grids of all samples, and then their numbers, with a row for each sample; for one, where all share A.
at::Tensor make_hierarchy(const HierarchyKernel& kernel, const at::Tensor& b);
inline Grids* grids_of(const at::Tensor& hierarchy) { return static_cast<Grids*>(hierarchy.mutable_data_ptr()); }
template <class T>
T* numbers_of(const at::Tensor& hierarchy) {
  return reinterpret_cast<T*>(grids_of(hierarchy) + hierarchy.size(0));
}
inline int64_t numbers_of_sample(const at::Tensor& hierarchy) {
  return hierarchy.size(1) - static_cast<int64_t>(sizeof(Grids) / hierarchy.element_size());
}

/// Numbers of the vectors of a cycle on all grids but the finest: what they take at most, and what they take where
/// every long axis is coarsened at once.
struct CycleMemory {
  int64_t at_most, if_all_axes;
};
CycleMemory memory_of_cycle(const at::Tensor& b);

}  // namespace prdp::gpu
