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

/// A in which the samples that take no part have the tensors of one that does; of a Function, where theirs are not
/// finite. Tensors that all samples share stay.
OperatorSpec with_healthy_tensors(OperatorSpec a, const Rows& take_part);

/// A in which the refused samples have tensors of ones, where nobody may look which they are; a Function stays.
OperatorSpec with_ones_where_refused(OperatorSpec a, const at::Tensor& status);

}  // namespace prdp
