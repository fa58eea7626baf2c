#pragma once
#include "prdp/autograd/finite_rows.h"
#include "prdp/operators/operator.h"

/// What a sum over samples is made of where some hold NaN: zero times NaN would spoil it, so these hold the numbers of
/// a healthy sample instead. All of it is differentiable.
namespace prdp {

/// The samples that were solved for.
Rows not_refused(const at::Tensor& status);

/// Whether tensor k of A has a row for each sample. Those of a function are taken to have one where they may.
bool is_of_samples(const OperatorSpec& a, size_t k, int64_t batch);

/// Of each sample, whether its rows of these tensors are finite.
Rows has_finite_tensors(const OperatorSpec& a, int64_t batch);

/// t with the first of these rows in place of all others.
at::Tensor with_healthy_rows(const at::Tensor& t, const Rows& healthy);

/// A for the samples that take part: in each tensor that is not finite in another sample, that has the rows of one that
/// does. A tensor that all samples share is finite where any takes part, and stays as it is.
OperatorSpec with_healthy_tensors(OperatorSpec a, const Rows& take_part);

}  // namespace prdp
