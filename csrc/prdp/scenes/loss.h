#pragma once
#include <ATen/ATen.h>

#include <string_view>

namespace prdp {

/// Mean over the batch of ‖u - reference‖² / ‖reference‖² (paper, appendix E): the loss "nmse", and
/// the validation metric of every scene that trains a network.
at::Tensor normalised_mse(const at::Tensor& u, const at::Tensor& reference);

/// "nmse", or "mse", the mean over all values of (u - reference)².
at::Tensor loss(std::string_view kind, const at::Tensor& u, const at::Tensor& reference);

/// ‖u - reference‖² / (2 N) of the task "parameters".
at::Tensor half_mse(const at::Tensor& u, const at::Tensor& reference);

/// ‖θ - reference‖ / ‖reference‖, the error that the task "parameters" brings down.
at::Tensor relative_error(const at::Tensor& theta, const at::Tensor& reference);

}  // namespace prdp
