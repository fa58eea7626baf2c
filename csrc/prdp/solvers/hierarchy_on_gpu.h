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
};

/// Of this operator, for vectors like b, (batch, channel, *shape). Raises Unavailable.
HierarchyKernel hierarchy_kernel(Runtime& runtime, OperatorView a, const at::Tensor& b);

/// The grids of each sample; of one, where all share A.
struct MadeHierarchy {
  at::Tensor grids, numbers;
  int64_t numbers_of_sample;  // 0: they share them
};
MadeHierarchy make_hierarchy(const HierarchyKernel& kernel, const at::Tensor& b);

/// Numbers of the vectors of a cycle on all grids but the finest: what they take at most, and what they take where
/// every long axis is coarsened at once.
struct CycleMemory {
  int64_t most, usual;
};
CycleMemory memory_of_cycle(const at::Tensor& b);

}  // namespace prdp::gpu
