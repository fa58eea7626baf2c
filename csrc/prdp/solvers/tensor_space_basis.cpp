#include <ATen/Context.h>

#include "prdp/operators/tensors.h"
#include "prdp/solvers/batch_loops.h"
#include "prdp/solvers/tensor_space.h"

/// The basis of GMRES and MINRES.
namespace prdp {

void TensorSpace::dots(const std::vector<Vector>& v, int64_t count, const Scalar& factor, const Vector& w,
                       Scalar* h) const {
  const auto scaled = factor * w.detach();
  for (int64_t i = 0; i < count; ++i) h[i] = dot(v[i].detach(), scaled);
}

TensorSpace::Scalar TensorSpace::subtract_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count,
                                                      const Scalar& factor, Vector& w) const {
  w = factor * w;
  for (int64_t i = 0; i < count; ++i) w = at::addcmul(w, h[i], v[i], -1);
  return dot(w.detach(), w.detach());
}

void TensorSpace::add_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, Vector& x) {
  if (in_loops_) return batch_loops::add_combination(h, v, count, x, active_);
  auto sum = x;
  for (int64_t i = 0; i < count; ++i) sum = at::addcmul(sum, h[i], v[i]);
  x = keep_frozen(sum, x);
}

TensorSpace::Scalar TensorSpace::inverse(const Scalar& a, const Scalar& scale) const {
  const auto vanishing = a.le(16 * limits_of(b_).epsilon * scale.abs()).logical_or(a.lt(negligible_));
  return at::where(vanishing, at::zeros_like(a), 1 / a);
}

void TensorSpace::damp(const Scalar* R, const Scalar* g, int64_t n, const Scalar& scale, const Scalar& keep,
                       Scalar* h) const {
  // argmin ‖[R; ε s I] h - [g; 0]‖ by QR. Samples to keep get R = 0 and the identity below it, and so do those whose
  // s is zero, as nothing was left to do: the stacked matrix has full rank.
  const auto wanted = keep.detach().eq(0);
  if (!wanted.any().item<bool>()) return;
  const at::NoTF32Guard full_precision;
  const int64_t batch = b_.size(0);
  auto stacked = at::zeros({batch, 2 * n, n}, b_.options());
  auto rhs = at::zeros({batch, 2 * n, 1}, b_.options());
  const auto number = [batch](const Scalar& s) { return s.detach().reshape(-1).expand(batch); };
  const auto safe = [&](const Scalar& s) { return at::where(number(wanted), number(s), at::zeros({}, s.options())); };
  for (int64_t j = 0; j < n; ++j) {
    for (int64_t i = 0; i <= j; ++i) stacked.select(1, i).select(1, j).copy_(safe(R[hessenberg_column(j) + i]));
    const auto is_damped = number(wanted).logical_and(number(scale).gt(0));
    stacked.select(1, n + j).select(1, j).copy_(at::where(is_damped, limits_of(b_).epsilon * number(scale), 1.0));
    rhs.select(1, j).select(1, 0).copy_(safe(g[j]));
  }
  const auto [q, upper] = at::linalg_qr(stacked);
  const auto found = at::linalg_solve_triangular(upper, at::matmul(q.mT(), rhs), /*upper=*/true);
  for (int64_t j = 0; j < n; ++j) h[j] = at::where(wanted, found.select(1, j).view_as(wanted), h[j]);
}

}  // namespace prdp
