#pragma once
#include <ATen/ATen.h>

#include <string>
#include <string_view>

namespace prdp {

/// The mean over the batch of ‖u - reference‖² / ‖reference‖² (paper, appendix E). It is the loss "nmse", and the
/// validation metric of every scene that trains a network.
at::Tensor normalised_mse(const at::Tensor& u, const at::Tensor& reference);

/// The loss of this kind: "nmse", as above, or "mse", the mean of (u - reference)² over all values.
at::Tensor loss(std::string_view kind, const at::Tensor& u, const at::Tensor& reference);

/// ‖u - reference‖² / (2 N), the loss of the task "parameters".
at::Tensor half_mse(const at::Tensor& u, const at::Tensor& reference);

/// ‖θ - reference‖ / ‖reference‖, the metric of the task "parameters".
at::Tensor relative_error(const at::Tensor& theta, const at::Tensor& reference);

/// Why a training is lost though its numbers are finite; empty if it is not. `first` and `last`: the relative errors
/// before and after it. One that is many times its own size says nothing else.
std::string why_lost(double first, double last);

}  // namespace prdp
