#include "prdp/operators/autocast.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/library.h>

/// The ops under torch.autocast: they take float16 and bfloat16 for float32, as torch.linalg does, and
/// compute in the dtype that they are given.
namespace prdp {

namespace {

at::Tensor at_least_float32(const at::Tensor& t) {
  const bool low = t.defined() && (t.scalar_type() == at::kHalf || t.scalar_type() == at::kBFloat16);
  return low ? t.to(at::kFloat) : t;
}

void in_full_precision(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  const WithoutAutocast here;
  const size_t arguments = op.schema().arguments().size();
  for (size_t i = stack->size() - arguments; i < stack->size(); ++i) {
    auto& argument = (*stack)[i];
    if (argument.isTensor()) {
      argument = at_least_float32(argument.toTensor());
    } else if (argument.isTensorList()) {
      auto tensors = argument.toTensorVector();
      for (auto& t : tensors) t = at_least_float32(t);
      argument = std::move(tensors);
    }
  }
  op.callBoxed(stack);
}

void register_ops(torch::Library& m) {
  for (const char* name : {"linear_solve", "step", "rollout", "rhs", "apply", "diagonal", "dense"})
    m.impl(name, torch::CppFunction::makeFromBoxedFunction<&in_full_precision>());
}

}  // namespace

TORCH_LIBRARY_IMPL(prdp, AutocastCPU, m) { register_ops(m); }
TORCH_LIBRARY_IMPL(prdp, AutocastCUDA, m) { register_ops(m); }

}  // namespace prdp
