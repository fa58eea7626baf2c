#include "prdp/autograd/adjoint_identity.h"

#include <cmath>

#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/report_failures.h"

namespace prdp {

namespace {

int64_t writes_to(const at::Tensor& b, const at::Tensor& u) {
  return static_cast<int64_t>(b._version()) + static_cast<int64_t>(u._version());
}

at::Tensor inner_product(const at::Tensor& v, const at::Tensor& w) {
  return (v.to(at::kDouble) * w.to(at::kDouble)).flatten(1).sum(1);
}

}  // namespace

void AdjointIdentity::keep(const at::Tensor& b, const Solved& solved) {
  const bool can_look =
      b.is_cpu() && is_plain(b) && is_plain(solved.u) && !b.is_inference() && !solved.u.is_inference();
  if (!can_look) return;
  b_ = b.detach();
  u_ = solved.u.detach();
  residual_ = solved.residual.detach();
  writes_ = writes_to(b_, u_);
}

bool AdjointIdentity::can_compare() const { return has_kept() && writes_to(b_, u_) == writes_; }

void AdjointIdentity::check_adjoint(const at::Tensor& cotangent, const at::Tensor& lambda, const SolveInfo& adjoint,
                                    FunctionCode& code) const {
  if (!can_compare()) return;
  const at::NoGradGuard no_grad;
  const auto forward_size = sample_norms(lambda) * sample_norms(b_),
             adjoint_size = sample_norms(u_) * sample_norms(cotangent);
  const auto forward = inner_product(lambda, b_), backward = inner_product(u_, cotangent);
  const auto of_residuals =
      4.0 * (forward_size * residual_.to(at::kDouble) + adjoint_size * adjoint.residual.to(at::kDouble));
  const auto of_rounding = std::sqrt(epsilon_of(lambda)) * (forward_size + adjoint_size);
  const auto differs = (forward - backward).abs().gt(of_residuals + of_rounding) & forward.isfinite() &
                       backward.isfinite() & adjoint.status.ge(static_cast<int64_t>(SolveStatus::kStagnated));
  if (!differs.any().item<bool>()) return;
  const auto sample = differs.nonzero()[0].item<int64_t>();
  warn_of_another_transpose(code, sample, forward[sample].item<double>(), backward[sample].item<double>());
}

void AdjointIdentity::check_product(const Operator& a, FunctionCode& code) const {
  if (!can_compare()) return;
  const at::NoGradGuard no_grad;
  const auto product = a.apply(u_), before = residual_.to(at::kDouble), of_b = sample_norms(b_);
  const auto now = sample_norms(b_ - product) / of_b;
  const auto rounding = 10.0 * std::sqrt(epsilon_of(u_)) * (1.0 + sample_norms(product) / of_b);
  const auto differs = (now - before).abs().gt(0.1 * before + rounding) & now.isfinite() & before.isfinite();
  if (!differs.any().item<bool>()) return;
  const auto sample = differs.nonzero()[0].item<int64_t>();
  warn_of_another_product(code, sample, now[sample].item<double>(), before[sample].item<double>());
}

}  // namespace prdp
