#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// Null vectors of A that somebody named, for each channel.
struct NamedNullSpace {
  int64_t vectors = 0;
  bool is_constant = false;  // one, the constant, on both sides
};

/// A⁻¹ b, or A⁻ᵀ b if `a` is transposed, of a stencil as tensor operations: on a line of points by cyclic reduction; of
/// a sum of symmetric operators along the axes in their eigenvectors, or by FFT where these are waves. With named null
/// vectors, the solution of least norm for a b in the range of A. Samples that are neither are solved with a dense
/// matrix or refused, as below; nothing if all are, or if null vectors are named and some are. The host looks once, at
/// lines of coefficients. Differentiable in b and in the coefficients.
std::optional<at::Tensor> solve_stencil_on_axes(const OperatorSpec& a, const at::Tensor& b,
                                                const NamedNullSpace& null_space);

/// The same for any stencil: by a dense matrix where there is no other way, and on the CPU. Raises NotImplementedError
/// on other devices if that takes too much memory.
at::Tensor solve_stencil_directly(const OperatorSpec& a, const at::Tensor& b);

}  // namespace prdp
