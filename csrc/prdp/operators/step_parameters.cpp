#include "prdp/operators/step_parameters.h"

#include <ATen/TensorSubclassLikeUtils.h>

#include <cmath>

namespace prdp {

std::vector<double> lengths_of(const OperatorSpec& spec, size_t others) {
  if (spec.parameters.size() <= others) return {};
  return {spec.parameters.begin() + static_cast<std::ptrdiff_t>(others), spec.parameters.end()};
}

StepParameters::StepParameters(const char* who, const OperatorSpec& spec, size_t tensors, const char* expected)
    : owner(who) {
  TORCH_CHECK_VALUE(!spec.parameters.empty() && spec.tensors.size() == tensors, owner,
                    ": takes the parameter dt, then the length of each axis if not 1, and ", expected);
  dt = spec.parameters[0];
  nu = spec.tensors.back();
  TORCH_CHECK_VALUE(std::isfinite(dt) && dt > 0.0, owner, ": dt must be finite and > 0, got ", dt);
  TORCH_CHECK_VALUE(nu.dim() == 0, owner, ": nu must be a number or a 0-dimensional tensor, got shape ", nu.sizes());
  TORCH_CHECK_TYPE(at::isFloatingType(nu.scalar_type()), owner, ": nu must be a real number, got ", nu.scalar_type());
}

void StepParameters::check_values(Checks checks) const {
  if (checks == Checks::kHost && !nu.is_cpu()) return;
  if (at::isTensorSubclassLike(nu)) return;  // no number yet; the solve checks it once there is one
  const double value = nu_value();
  TORCH_CHECK_VALUE(std::isfinite(value) && value >= 0.0, owner, ": nu must be finite and >= 0, got ", value);
}

double number_of(const at::Tensor& t) {
  // Read where it lies: item() takes as long as a tenth of a small step.
  if (t.is_cpu() && t.has_storage() && !t.is_neg()) {
    if (t.scalar_type() == at::kDouble) return *t.const_data_ptr<double>();
    if (t.scalar_type() == at::kFloat) return *t.const_data_ptr<float>();
  }
  return t.item<double>();
}

}  // namespace prdp
