#pragma once
#include "prdp/autograd/unrolled_vjp.h"

namespace prdp {

/// The derivative of the iterations of all samples.
using OfIterations = UnrolledVjp (*)(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                                     at::IntArrayRef needed);

/// Takes the derivative that each sample gets (unrolled_vjp.h): by `of_iterations`, or with an adjoint solve by
/// `any_solve`, which also solves again for a u that is not kept.
SolveVjp vjp_of_samples(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& spec,
                        const SolveOptions& options, at::IntArrayRef needed, OfIterations of_iterations,
                        decltype(linear_solve)& any_solve);

}  // namespace prdp
