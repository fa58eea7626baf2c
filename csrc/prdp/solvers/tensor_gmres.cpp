#include "prdp/solvers/tensor_gmres.h"

#include <ATen/Context.h>

#include <algorithm>
#include <cmath>

#include "prdp/solvers/hessenberg_problem.h"
#include "prdp/solvers/solve_damped.h"

namespace prdp {

namespace {

/// Numbers of one sample on the host, which vanish where those of its dtype would.
struct HostNumbers {
  using Scalar = double;
  double epsilon, negligible;

  template <class X>
  std::vector<X> array(int64_t n) const {
    return std::vector<X>(n);
  }

  double inverse(double value, double scale) const {
    return value <= 16 * epsilon * std::abs(scale) || value < negligible ? 0.0 : 1.0 / value;
  }
  double larger(double a, double b) const { return std::max(a, b); }
  double is_larger(double a, double b) const { return a > b; }
  double is_zero(double value) const { return value == 0.0; }
  double is_not_zero(double value) const { return value != 0.0; }
  bool surely_all(double value) const { return value != 0.0; }
  void damp(const double* r, const double* g, int64_t n, double scale, double keep, double* y) const {
    if (keep != 0.0) return;
    std::vector<double> work(numbers_of_solve_damped(n));
    solve_damped(r, g, n, epsilon * scale, y, work.data());
  }
};

}  // namespace

TensorGmres::TensorGmres(TensorSpace& space, int64_t restart)
    : x(space.vector()), space_(space), m_(std::min(restart, space.unknowns())) {}

void TensorGmres::start() {
  x = space_.vector();
  r_ = space_.b();
  residual2_ = space_.b2();
  exhausted_ = space_.is_zero(residual2_);
  scale_.assign(space_.b().size(0), 0.0);
  is_first_ = true;
  ready_ = true;
  confirmed_ = !space_.started();
}

void TensorGmres::step() {
  residual2();
  kept_x_ = x;
  kept_r_ = r_;
  extend_basis();
  const auto y = minimise();
  at::Tensor d = at::bmm(rows(m_ - 1).mT(), y).view(space_.b().sizes());
  if (space_.is_preconditioned()) {
    auto z = space_.vector();
    space_.precondition(d, z);
    d = z;
  }
  space_.add(d, x);
  v_ = at::Tensor();
  ready_ = false;
  confirmed_ = true;
}

at::Tensor TensorGmres::residual2() {
  if (ready_) return residual2_;
  const auto fresh = space_.residual(x, r_), grew = fresh.gt(residual2_);
  x = at::where(grew, kept_x_, x);
  r_ = at::where(grew, kept_r_, r_);
  residual2_ = at::where(grew, residual2_, fresh);
  ready_ = true;
  return residual2_;
}

at::Tensor TensorGmres::recompute_residual() {
  if (confirmed_) return residual2();
  confirmed_ = true;
  return residual2_ = space_.residual(x, r_);
}

void TensorGmres::extend_basis() {
  const auto& b = space_.b();
  const int64_t batch = b.size(0);
  v_ = at::empty({m_, batch, space_.unknowns()}, b.options());  // a Function may keep what it was given before
  h_ = at::zeros({batch, m_ + 1, m_}, b.options());
  auto first = vector(0);
  at::div_out(first, r_, residual2_.sqrt().clamp_min(space_.negligible()));
  auto z = space_.vector(), w = at::Tensor();
  for (int64_t j = 0; j < m_; ++j) {
    if (space_.is_preconditioned()) space_.precondition(vector(j), z);
    space_.apply(space_.is_preconditioned() ? z : vector(j), w);
    orthogonalise(j, w.reshape({batch, -1, 1}));
  }
}

/// w ← w - Σ h_ij v_i with h_ij = v_i·w, twice; v_{j+1} = w/‖w‖. A w that vanishes leaves the zero vector or noise, of
/// which minimise() takes no heed.
void TensorGmres::orthogonalise(int64_t j, const at::Tensor& w) {
  const auto basis = rows(j);
  const auto once = at::bmm(basis, w), rest = at::baddbmm(w, basis.mT(), once, 1, -1);
  const auto again = at::bmm(basis, rest), left = at::baddbmm(rest, basis.mT(), again, 1, -1);
  auto column = h_.narrow(2, j, 1), along = column.narrow(1, 0, j + 1), length = column.narrow(1, j + 1, 1);
  at::add_out(along, once, again);
  at::linalg_vector_norm_out(length, left, 2, {{1}}, /*keepdim=*/true);
  if (j + 1 == m_) return;
  auto next = v_.select(0, j + 1).unsqueeze(-1);
  at::div_out(next, left, length.clamp_min(space_.negligible()));
}

at::Tensor TensorGmres::minimise() {
  const int64_t batch = h_.size(0), size = (m_ + 1) * m_;
  const auto host = at::cat({h_.flatten(1), residual2_.flatten(1)}, 1).to(at::kCPU, at::kDouble);
  auto y = at::zeros({batch, m_, 1}, at::kDouble), exhausted = at::empty({batch}, at::kDouble);
  const HostNumbers numbers{2 * space_.epsilon(), space_.negligible()};
  for (int64_t sample = 0; sample < batch; ++sample) {
    const double* h = host.const_data_ptr<double>() + sample * (size + 1);
    const double length = std::sqrt(h[size]);
    HessenbergProblem problem(numbers, m_);
    problem.start(h[size], space_.enough2_of(sample));
    if (!is_first_) problem.leave_first();
    problem.scale() = scale_[sample];
    problem.begin(length);
    int64_t columns = 0;
    while (columns < m_ && !(columns > 0 && problem.ended(columns - 1) != 0.0)) {
      double* column = problem.column(columns);
      double square = 0.0;
      for (int64_t i = 0; i <= columns + 1; ++i) {
        column[i] = h[i * m_ + columns];
        square += column[i] * column[i];
      }
      problem.add_column(columns++, std::sqrt(square));
    }
    problem.minimise(columns, length, 1.0);
    for (int64_t j = 0; j < columns; ++j)
      y.mutable_data_ptr<double>()[sample * m_ + j] = problem.inverse_length(j) == 0.0 ? 0.0 : problem.y(j);
    scale_[sample] = problem.scale();
    exhausted.mutable_data_ptr<double>()[sample] = problem.exhausted();
  }
  is_first_ = false;
  exhausted_ = exhausted;
  return y.to(h_.options());
}

}  // namespace prdp
