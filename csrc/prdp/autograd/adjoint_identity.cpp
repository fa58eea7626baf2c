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

void AdjointIdentity::keep(const at::Tensor& b, const Solved& solved, bool unrolled) {
  const bool can_look =
      b.is_cpu() && is_plain(b) && is_plain(solved.u) && !b.is_inference() && !solved.u.is_inference();
  if (!can_look) return;
  unrolled_ = unrolled;
  b_ = b.detach();
  u_ = solved.u.detach();
  residual_ = solved.residual.detach();
  writes_ = writes_to(b_, u_);
}

void AdjointIdentity::check(const at::Tensor& cotangent, const at::Tensor& b_bar, const SolveInfo& adjoint,
                            FunctionCode& code) const {
  if (writes_to(b_, u_) != writes_) return;
  const at::NoGradGuard no_grad;
  const auto forward_size = sample_norms(b_bar) * sample_norms(b_),
             adjoint_size = sample_norms(u_) * sample_norms(cotangent);
  const auto forward = inner_product(b_bar, b_), backward = inner_product(u_, cotangent);
  // NaN where no system was solved: there the iterations themselves were differentiated.
  const auto solved = adjoint.residual.to(at::kDouble);
  const auto of_residuals = 4.0 * (forward_size * residual_.to(at::kDouble) + adjoint_size * solved).nan_to_num(0.0);
  constexpr double of_iterations = 100.0;  // whose derivative gathers more rounding
  const double rounding = (unrolled_ ? of_iterations : 1.0) * std::sqrt(epsilon_of(b_bar));
  const auto is_told = unrolled_ ? adjoint.status.eq(static_cast<int64_t>(SolveStatus::kMaxIter)) | adjoint.status.gt(0)
                                 : adjoint.status.ge(static_cast<int64_t>(SolveStatus::kStagnated));
  const auto differs = (forward - backward).abs().gt(of_residuals + rounding * (forward_size + adjoint_size)) &
                       forward.isfinite() & backward.isfinite() & is_told;
  if (!differs.any().item<bool>()) return;
  const auto sample = differs.nonzero()[0].item<int64_t>();
  warn_of_another_product(code, unrolled_, sample, forward[sample].item<double>(), backward[sample].item<double>());
}

}  // namespace prdp
