#pragma once
#include <ATen/ATen.h>

#include <algorithm>
#include <limits>
#include <tuple>
#include <vector>

#include "prdp/error_text.h"

/// What batches of tensors need everywhere.
namespace prdp {

/// (batch,) → (batch, 1, …), to multiply or mask a batch of vectors.
inline at::Tensor per_sample(at::Tensor t, const at::Tensor& like) {
  while (t.dim() < like.dim()) t = t.unsqueeze(-1);
  return t;
}

/// t with zeros in these samples, of a mask (batch,), even if they were not finite; either may be undefined.
/// Differentiable.
inline at::Tensor cleared(const at::Tensor& t, const at::Tensor& samples) {
  return samples.defined() && t.defined() ? t.masked_fill(per_sample(samples, t), 0.0) : t;
}

/// The unknowns of one channel of v, as its last axis: (…, n).
inline at::Tensor by_channel(const at::Tensor& v) { return v.dim() < 3 ? v : v.flatten(2); }

/// The dtype of a float32 or float64 tensor: the distance from 1 to its next number, its least numbers, its largest.
struct Limits {
  double epsilon, least_normal, least, largest;
};
inline Limits limits_of(const at::Tensor& t) {
  const auto of = [](auto limits) -> Limits {
    return {limits.epsilon(), limits.min(), limits.denorm_min(), limits.max()};
  };
  return t.scalar_type() == at::kFloat ? of(std::numeric_limits<float>()) : of(std::numeric_limits<double>());
}
inline double epsilon_of(const at::Tensor& t) { return limits_of(t).epsilon; }

/// One number per sample, on the host; `t` may hold a single one for all.
template <class T>
std::vector<T> to_host(const at::Tensor& t, int64_t batch) {
  const auto flat =
      t.detach().to(at::kCPU, c10::CppTypeToScalarType<T>::value).reshape({-1}).expand({batch}).contiguous();
  return {flat.template const_data_ptr<T>(), flat.template const_data_ptr<T>() + batch};
}

/// ‖v‖ of each sample, (batch,) in float64.
inline at::Tensor sample_norms(const at::Tensor& v) {
  return at::linalg_vector_norm(v.flatten(1), 2, at::IntArrayRef{1}, /*keepdim=*/false, at::kDouble);
}

/// max |v| of each sample, (batch,) in float64.
inline at::Tensor sample_maxima(const at::Tensor& v) {
  return at::linalg_vector_norm(v.flatten(1), INFINITY, at::IntArrayRef{1}, /*keepdim=*/false, at::kDouble);
}

/// The powers of two that bring these magnitudes to the order of one.
inline at::Tensor power_of_two_scale(const at::Tensor& magnitude) {
  const int limit = magnitude.scalar_type() == at::kFloat ? 126 : 1022;
  const auto exponent = std::get<1>(at::frexp(magnitude)).sub(1).clamp(-limit, limit);
  return at::ldexp(at::ones_like(magnitude), exponent.neg());
}

/// Vectors with samples scaled by powers of two to the order of one, by their `magnitude`, and zero where they do not
/// take part; all do where `takes_part` is undefined. Differentiable.
struct ScaledSamples {
  at::Tensor v, scale;
};
inline ScaledSamples scale_samples(const at::Tensor& v, const at::Tensor& magnitude,
                                   const at::Tensor& takes_part = {}) {
  if (!takes_part.defined()) {
    const auto scale = per_sample(power_of_two_scale(magnitude), v);
    return {v * scale, scale};
  }
  const auto safe = at::where(takes_part, magnitude, at::ones_like(magnitude));
  const auto scale = per_sample(power_of_two_scale(safe), v);
  return {at::where(per_sample(takes_part, v), v, at::zeros_like(v)) * scale, scale};
}
/// The same, of those that have a finite magnitude and are not zero.
inline ScaledSamples scale_finite_samples(const at::Tensor& v, const at::Tensor& magnitude) {
  return scale_samples(v, magnitude, magnitude.isfinite().logical_and(magnitude.gt(0)));
}

/// t with so many zeros before and behind it along an axis.
inline at::Tensor padded(const at::Tensor& t, int64_t axis, int64_t before, int64_t behind) {
  std::vector<int64_t> pad(2 * (t.dim() - axis), 0);
  pad[pad.size() - 2] = before;
  pad[pad.size() - 1] = behind;
  return at::constant_pad_nd(t, pad);
}

/// Raises unless `given`, "the winds" of `owner`, has the dtype and device of the vector, and its batch or 1.
inline void check_goes_with(const at::Tensor& given, const at::Tensor& vector, const char* owner, const char* name) {
  TORCH_CHECK_VALUE(given.sym_size(0) == 1 || given.sym_size(0) == vector.sym_size(0), owner, ": ", name, " hold ",
                    given.sym_size(0), " samples, the vector holds ", vector.sym_size(0));
  TORCH_CHECK_TYPE(vector.scalar_type() == given.scalar_type(), owner, ": ", name, " are ",
                   dtype_name(given.scalar_type()), " but the vector is ", dtype_name(vector.scalar_type()));
  TORCH_CHECK_VALUE(vector.device() == given.device(), owner, ": ", name, " are on ", given.device(),
                    " but the vector is on ", vector.device());
}

/// (channels, *shape)
inline std::vector<int64_t> with_channels(int64_t channels, at::IntArrayRef shape) {
  std::vector<int64_t> sizes{channels};
  sizes.insert(sizes.end(), shape.begin(), shape.end());
  return sizes;
}

/// sum += term; an undefined tensor is a zero of any shape.
inline void add_to(at::Tensor& sum, const at::Tensor& term) {
  if (term.defined()) sum = sum.defined() ? sum + term : term;
}

/// t without its history, for autograd to record anew, which saves no tensors of inference mode.
inline at::Tensor detached(const at::Tensor& t) {
  return t.is_inference() && !c10::InferenceMode::is_enabled() ? t.clone() : t.detach();
}
/// The same tensors, but copies of those of inference mode.
inline std::vector<at::Tensor> recordable(at::TensorList tensors) {
  auto found = tensors.vec();
  for (auto& t : found)
    if (t.is_inference()) t = detached(t);
  return found;
}
inline std::vector<at::Tensor> detached(at::TensorList tensors) {
  std::vector<at::Tensor> plain;
  for (const auto& t : tensors) plain.push_back(detached(t));
  return plain;
}

inline bool any_requires_grad(at::TensorList tensors) {
  return std::any_of(tensors.begin(), tensors.end(), [](const at::Tensor& t) { return t.requires_grad(); });
}

}  // namespace prdp
