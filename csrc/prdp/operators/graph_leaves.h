#pragma once
#include <ATen/ATen.h>

#include <unordered_set>

namespace prdp {

using Leaves = std::unordered_set<const c10::TensorImpl*>;
/// The leaves that a derivative of `t` would go back to.
Leaves leaves_of(const at::Tensor& t);

}  // namespace prdp
