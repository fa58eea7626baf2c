#include "prdp/solvers/null_space_messages.h"

#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/unnamed_null_space.h"

namespace prdp {

namespace {

double norm_of(const at::Tensor& v) { return v.to(at::kDouble).norm().item<double>(); }

/// Whether the null space of A is known: somebody named it, or it is that of a pressure.
bool knows_null_space(const SolveRole& role) { return is_singular(role.a) || operator_kind(role.a.kind).has_pressure; }

/// How to name the constant that A, or Aᵀ if `transposed`, maps to zero: that of each channel, or of all together.
std::string name_the_null_space(const Operator& a, const at::Tensor& b, int64_t sample, bool transposed) {
  if (b.dim() < 3 || b.size(1) == 1 || maps_constant_to_zero(a, b, transposed)[sample].item<bool>())
    return std::string("give ") + in_language("nullspace=\"constant\" to the operator", "prdp::with_null_space(a)") +
           ", or all vectors if it maps more to zero";
  return c10::str("give that of all channels together as a vector, ",
                  in_language("nullspace=torch.ones", "prdp::with_null_space(a, at::ones"), "(1, ",
                  c10::Join(", ", b.sizes().slice(1)), ")", in_language("", ")"), " in the dtype of b");
}

}  // namespace

std::string undeclared_null_space(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  const bool is_there = a.may_be_singular() && !knows_null_space(role) &&
                        maps_constant_to_zero(a, b, /*transposed=*/false, /*jointly=*/true)[sample].item<bool>();
  if (!is_there) return {};
  return "A maps the constant to zero, so it is singular; " + name_the_null_space(a, b, sample, /*transposed=*/false);
}

std::string inconsistent(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  if (!knows_null_space(role))
    return std::string(role.adjoint ? "the cotangent" : "b") + " has a constant part, which " +
           (role.adjoint ? "Aᵀ" : "A") + " cannot reach, as " + (role.adjoint ? "A" : "Aᵀ") +
           " maps the constant to zero; " + (role.adjoint ? "" : "take the mean off b, and ") +
           name_the_null_space(a, b, sample, /*transposed=*/true);
  const auto outside = (b - a.project(b)).select(0, sample);
  const auto share = three_digits(100.0 * norm_of(outside) / norm_of(b.select(0, sample))) + " % of ";
  if (!operator_kind(role.a.kind).has_pressure) {
    const auto fields = outside.dim() > 1 ? outside.flatten(1) : outside.unsqueeze(0);
    const bool is_constant =
        norm_of(fields - fields.mean(1, /*keepdim=*/true)) <= std::sqrt(epsilon_of(b)) * norm_of(outside);
    return share + "b lies outside the range of A" +
           (is_constant ? "; take the mean off b" : "; take a b without that part");
  }
  if (role.adjoint)
    return share +
           "the cotangent is the mean of its pressure, which the step leaves free; take the mean off the "
           "pressure that the loss is made of";
  return share + "b is the mean of its pressure channel, which no flow can have; take it off";
}

}  // namespace prdp
