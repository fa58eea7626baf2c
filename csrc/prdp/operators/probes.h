#pragma once
#include "prdp/operators/operator.h"

/// What a few products tell of an operator that says nothing of itself.
namespace prdp {

/// A vector of no structure, the same for each sample of `like`.
at::Tensor unstructured_like(const at::Tensor& like);

/// Powers of two with either sign, down to 2⁻⁷, so that a product with them rounds as one with 1; the first is 1.
at::Tensor unlike_numbers(int64_t count, const at::TensorOptions& options);

/// A vector (n,) in each channel of `like`, (batch, n) or (batch, channels, n), times such numbers: a product with it
/// is zero only if that with the vector in one channel alone is.
at::Tensor in_each_channel(const at::Tensor& vector, const at::Tensor& like);

/// About ‖A‖ of each sample, from below: the largest growth of such a vector in a few products.
at::Tensor estimated_norm(const Operator& a, const at::Tensor& like);

}  // namespace prdp
