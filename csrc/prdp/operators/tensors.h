#pragma once
#include <ATen/ATen.h>

#include <algorithm>

/// What batches of tensors need everywhere.
namespace prdp {

/// (batch,) → (batch, 1, …), to multiply or mask a batch of vectors.
inline at::Tensor per_sample(at::Tensor t, const at::Tensor& like) {
  while (t.dim() < like.dim()) t = t.unsqueeze(-1);
  return t;
}

/// sum += term; an undefined tensor is a zero of any shape.
inline void add_to(at::Tensor& sum, const at::Tensor& term) {
  if (term.defined()) sum = sum.defined() ? sum + term : term;
}

inline bool any_requires_grad(at::TensorList tensors) {
  return std::any_of(tensors.begin(), tensors.end(), [](const at::Tensor& t) { return t.requires_grad(); });
}

}  // namespace prdp
