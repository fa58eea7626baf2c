#pragma once
#include "prdp/operators/operator.h"

/// What a few products tell of an operator that says nothing of itself.
namespace prdp {

/// A vector of no structure, the same for each sample of `like`.
at::Tensor unstructured_like(const at::Tensor& like);

/// About ‖A‖ of each sample, from below: the largest growth of such a vector in a few products.
at::Tensor estimated_norm(const Operator& a, const at::Tensor& like);

}  // namespace prdp
