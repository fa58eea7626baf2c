#include "prdp/solvers/unfit.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "prdp/error_text.h"
#include "prdp/operators/probes.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"

namespace prdp {

namespace {

/// One sample of a batch of vectors.
at::Tensor row(const at::Tensor& v, int64_t sample) { return v.select(0, sample).flatten().to(at::kDouble); }

/// How far A is from symmetric, for vectors without structure of this sample: ‖A v - Aᵀ v‖ / ‖A v‖, and, as the
/// transpose of a function may be claimed to be A itself, |⟨A v, w⟩ - ⟨v, A w⟩| / (‖A v‖ ‖w‖). NaN for a function
/// without a transpose.
double asymmetry(const Operator& a, const at::Tensor& b, int64_t sample) try {
  const auto v = unstructured_like(b), w = v.flatten(1).roll(1, 1).view_as(v);
  const auto product = row(a.apply(v), sample), other = row(a.apply_transpose(v), sample);
  const double claimed = (product.dot(row(w, sample)) - row(v, sample).dot(row(a.apply(w), sample))).item<double>();
  return std::max(norm_of(product - other) / norm_of(product),
                  std::abs(claimed) / (norm_of(product) * norm_of(row(w, sample))));
} catch (const std::exception&) {  // it has nothing to add to a message
  return std::numeric_limits<double>::quiet_NaN();
}

/// How far M⁻¹ (-2 v) is from -2 M⁻¹ v, beside the latter.
double nonlinearity(const Operator& m, const at::Tensor& b, int64_t sample) {
  const auto v = unstructured_like(b);
  const auto doubled = -2.0 * row(m.apply(v), sample);
  return norm_of(row(m.apply(-2.0 * v), sample) - doubled) / norm_of(doubled);
}

/// Functions may be made of differences, which are linear and symmetric but for so much.
double rounding_of_differences(const at::Tensor& b) { return 32.0 * std::sqrt(epsilon_of(b)); }

bool needs_symmetry(Method method) {
  const auto made_for = traits(method).made_for;
  return made_for == MadeFor::kDefinite || made_for == MadeFor::kSymmetric;
}

/// How much asymmetry() of a symmetric A may be.
double rounding_of_asymmetry(const FailedSample& sample) {
  return is_function(sample.role.a) ? rounding_of_differences(sample.b) : 100.0 * epsilon_of(sample.b);
}

}  // namespace

bool is_symmetric(const FailedSample& sample) {
  return asymmetry(sample.a, sample.b, sample.index) <= rounding_of_asymmetry(sample);
}

std::string asymmetric(const FailedSample& sample) {
  const double share = asymmetry(sample.a, sample.b, sample.index);
  if (!(share > rounding_of_asymmetry(sample))) return {};
  return "A is not symmetric (‖A v - Aᵀ v‖ is " + three_digits(share) + " ‖A v‖ for a v of no structure); take GMRES";
}

std::string unfit(const FailedSample& sample) {
  const at::NoGradGuard no_grad;
  const bool symmetric = needs_symmetry(sample.solver().method);
  if (symmetric)
    if (auto found = asymmetric(sample); !found.empty()) return found;
  if (!sample.preconditioner().is_operator()) return {};
  const auto m = make_operator(sample.preconditioner().spec());
  const double rounding = rounding_of_differences(sample.b);
  if (nonlinearity(*m, sample.b, sample.index) > rounding)
    return "its preconditioner is not linear: M⁻¹(-2 v) is not -2 M⁻¹ v; a network is linear without biases and "
           "activations";
  const double share = symmetric ? asymmetry(*m, sample.b, sample.index) : 0.0;
  if (!(share > rounding)) return {};
  return "its preconditioner is not symmetric (‖M⁻¹v - M⁻ᵀv‖ is " + three_digits(share) +
         " ‖M⁻¹v‖ for a v of no structure); take GMRES";
}

bool preconditions_with_operator(const FailedSample& sample) {
  const at::NoGradGuard no_grad;
  const auto m = make_operator(sample.preconditioner().spec());
  const auto v = unstructured_like(sample.b);
  const auto direction = [&](const at::Tensor& of) {
    const auto all = row(of, sample.index);
    return all / norm_of(all);
  };
  const auto by_a = direction(sample.a.apply(v));
  const auto off = [&](const at::Tensor& of) { return 1.0 - std::abs(by_a.dot(direction(of)).item<double>()); };
  constexpr double little = 0.01;  // where A nearly is a multiple of the identity, so is its inverse
  const double of_identity = off(v);
  return of_identity > little && off(m->apply(v)) < 0.5 * of_identity;
}

}  // namespace prdp
