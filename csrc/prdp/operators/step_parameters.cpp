#include "prdp/operators/step_parameters.h"

#include <ATen/TensorSubclassLikeUtils.h>

#include <cmath>
#include <limits>
#include <sstream>

#include "prdp/error_text.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"

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
  TORCH_CHECK_VALUE(nu.defined() && nu.dim() <= 1, owner,
                    ": nu must be a number, a 0-dimensional tensor, or (batch,), one for each "
                    "sample, got shape ",
                    nu.sizes());
  TORCH_CHECK_TYPE(at::isFloatingType(nu.scalar_type()), owner, ": nu must be a real number, got ",
                   dtype_name(nu.scalar_type()));
}

namespace {
bool is_allowed(double nu) { return std::isfinite(nu) && nu >= 0.0; }
std::vector<double> numbers_of(const at::Tensor& nu) {
  if (nu.dim() == 0) return {number_of(nu)};
  return to_host<double>(nu.resolve_neg(), nu.numel());
}
}  // namespace

void StepParameters::check_vector(const at::Tensor& b) const {
  if (has_axis()) check_goes_with(nu, b, owner, "the values of nu");
}

void StepParameters::check_values(Checks checks) const {
  if (checks == Checks::kHost && !nu.is_cpu()) return;
  if (checks == Checks::kShared && has_axis()) return;
  if (at::isTensorSubclassLike(nu)) return;  // no number yet; the solve checks it once there is one
  const auto values = numbers_of(nu);
  for (size_t i = 0; i < values.size(); ++i)
    TORCH_CHECK_VALUE(is_allowed(values[i]), owner, ": nu must be finite and >= 0, got ", values[i],
                      has_axis() ? " in sample " + std::to_string(i) : "");
}

std::string StepParameters::refusal(int64_t sample) const {
  if (!has_axis()) return {};
  const auto value = nu[nu.size(0) == 1 ? 0 : sample].item<double>();
  if (is_allowed(value) || !std::isfinite(value)) return {};
  std::ostringstream text;
  text << "nu must be >= 0, got " << value << "; what a network predicts should end in exp or softplus";
  return text.str();
}

std::vector<double> StepParameters::nu_values() const {
  auto values = numbers_of(nu);
  for (auto& value : values)
    if (has_axis() && !is_allowed(value)) value = std::numeric_limits<double>::quiet_NaN();
  return values;
}

at::Tensor StepParameters::nu_beside(int64_t axes) const {
  if (!has_axis()) return nu;
  auto shape = nu.sym_sizes().vec();
  shape.resize(2 + axes, 1);
  return nu.view_symint(shape);
}

at::Tensor StepParameters::nu_of(const at::Tensor& index) const {
  return has_axis() && nu.size(0) != 1 ? nu.index_select(0, index) : nu;
}

at::Tensor StepParameters::gradient(const at::Tensor& terms) const {
  if (!has_axis() || nu.sym_size(0) == 1) return total(terms).reshape_symint(nu.sym_sizes()).to(nu.options());
  return sample_totals(terms).flatten().to(nu.options());
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
