#pragma once
#include <ATen/ATen.h>
#include <ATen/core/grad_mode.h>

#include <limits>

#include "prdp/gpu/device/product_rules.h"
#include "prdp/gpu/launch.h"
#include "prdp/gpu/operator_view.h"
#include "prdp/operators/plain_tensors.h"

/// Product rules in one launch on a GPU: for plain tensors, where autograd does not record.
namespace prdp {

inline bool has_product_rule_kernel(const at::Tensor& lambda, const at::Tensor& u) {
  return gpu::runtime_of(lambda.device()) && !at::GradMode::is_enabled() && is_plain(lambda) && is_plain(u) &&
         lambda.numel() > 0 && lambda.numel() <= std::numeric_limits<int>::max() / 2;  // kernels count by int
}

/// λ and u, contiguous, (batch, channels, *shape), for fields of so many sets: one for each sample, or one.
template <class T>
gpu::PairOfVectors<T> pair_of(const at::Tensor& lambda, const at::Tensor& u, int64_t sets) {
  return {lambda.const_data_ptr<T>(), u.const_data_ptr<T>(), static_cast<int>(lambda.size(1)),
          static_cast<int>(c10::multiply_integers(lambda.sizes().slice(2))),
          static_cast<int>(sets == 1 ? lambda.size(0) : 1)};
}

template <class T>
gpu::Body product_rule_body(const char* name, const char* header = "prdp/gpu/device/product_rules.h") {
  return {std::string(name) + (std::is_same_v<T, float> ? "<float>" : "<double>"), header};
}

}  // namespace prdp
