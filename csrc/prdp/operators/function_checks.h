#pragma once
#include <functional>

#include "prdp/operators/operator.h"

/// What the products of a Function are refused for.
namespace prdp {

/// What messages call the product with A.
const char* product_name();

/// A product of constants, detached. Raises ValueError if it has a derivative: in forward mode any, in reverse mode, if
/// that is asked for, one by a tensor that was there before.
at::Tensor product_without_captures(const std::function<at::Tensor()>& product, bool reverse = true);

/// A product that captures a tensor which requires grad, instead of getting it as an argument, would silently lose its
/// gradient. After this call, the operator's next product below autograd raises ValueError in that case, at the cost of
/// recording it. Each differentiable solve asks anew: a parameter may have been frozen before.
void refuse_captured_gradients(const OperatorSpec& a);
/// The same of what a transform of torch.func follows at its level, where b is: by a product that is not used.
/// refuse_mapped_captures() looks for what vmap maps over alone.
void refuse_captured_transforms(const OperatorSpec& a, const at::Tensor& b);
void refuse_mapped_captures(const OperatorSpec& a, const at::Tensor& b);
/// Raises ValueError where a solver would solve another problem than was meant: in the first solve on the CPU with this
/// code, where A (-2 v) is not about -2 A v; in the 1st, 2nd, 4th, 8th, …, as what a function captures may change,
/// where A 0 is no rounding beside b, or a sample changes another one. Returns whether it looked.
bool refuse_nonlinear_product(const OperatorSpec& a, const at::Tensor& b);

}  // namespace prdp
