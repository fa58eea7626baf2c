#include "prdp/solvers/tensor_gmres.h"

#include <ATen/Context.h>

#include <algorithm>
#include <cmath>

#include "prdp/solvers/batch_loops.h"
#include "prdp/solvers/solve_damped.h"

namespace prdp {

double HostNumbers::inverse(double value, double scale) const {
  return value <= 16 * epsilon * std::abs(scale) || value < negligible ? 0.0 : 1.0 / value;
}

void HostNumbers::damp(const double* r, const double* g, int64_t n, double scale, double keep, double* y) const {
  if (keep != 0.0) return;
  std::vector<double> work(numbers_of_solve_damped(n));
  solve_damped(r, g, n, epsilon * scale, y, work.data());
}

TensorGmres::TensorGmres(TensorSpace& space, int64_t restart)
    : x(space.vector()),
      space_(space),
      m_(std::min(restart, space.unknowns())),
      numbers_{2 * space.unit_roundoff(), space.negligible()} {}

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
  at::Tensor d = space_.in_loops() ? batch_loops::combination(v_, y) : at::bmm(rows(m_ - 1).mT(), y.to(h_.options()));
  d = d.view(space_.b().sizes());
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
  if (space_.in_loops()) begin_cycles(residual2_.to(at::kDouble).contiguous().const_data_ptr<double>());
  else h_ = at::zeros({batch, m_ + 1, m_}, b.options());
  auto first = vector(0);
  at::div_out(first, r_, residual2_.sqrt().clamp_min(space_.negligible()));
  auto z = space_.vector(), w = space_.vector();
  for (int64_t j = 0; j < m_; ++j) {
    if (space_.is_preconditioned()) space_.precondition(vector(j), z);
    space_.apply(space_.is_preconditioned() ? z : vector(j), w);
    if (!space_.in_loops()) {
      orthogonalise_on_device(j, w.reshape({batch, -1, 1}));
    } else if (orthogonalise_in_loops(j, w)) {
      v_ = v_.narrow(0, 0, j + 1);
      return;
    }
  }
}

bool TensorGmres::orthogonalise_in_loops(int64_t j, at::Tensor& w) {
  std::vector<double*> columns;
  for (auto& cycle : cycles_) columns.push_back(cycle.has_ended() ? nullptr : cycle.next_column());
  batch_loops::orthogonalise(v_, j, space_.negligible(), w, columns);
  std::vector<bool> ended;
  for (auto& cycle : cycles_) {
    if (!cycle.has_ended()) cycle.take_column();
    ended.push_back(cycle.has_ended());
  }
  return space_.all_ended(ended);
}

void TensorGmres::begin_cycles(const double* residual2) {
  cycles_.clear();
  for (size_t s = 0; s < scale_.size(); ++s) {
    cycles_.push_back({HessenbergProblem<HostNumbers>(numbers_, m_), std::sqrt(residual2[s])});
    auto& problem = cycles_.back().problem;
    problem.start(residual2[s], space_.enough2_of(static_cast<int64_t>(s)));
    if (!is_first_) problem.leave_first();
    problem.scale() = scale_[s];
    problem.begin(cycles_.back().length);
  }
}

void TensorGmres::Cycle::take_column() {
  double square = 0.0;
  for (int64_t i = 0; i <= columns + 1; ++i) square += next_column()[i] * next_column()[i];
  problem.add_column(columns, std::sqrt(square));
  ++columns;
}

void TensorGmres::take_columns_from_device() {
  const int64_t batch = h_.size(0), size = (m_ + 1) * m_;
  const auto host = at::cat({h_.flatten(), residual2_.flatten().to(h_.scalar_type())}).to(at::kCPU, at::kDouble);
  const double* h = host.const_data_ptr<double>();
  begin_cycles(h + batch * size);
  for (auto& cycle : cycles_) {
    while (cycle.columns < m_ && !cycle.has_ended()) {
      for (int64_t i = 0; i <= cycle.columns + 1; ++i) cycle.next_column()[i] = h[i * m_ + cycle.columns];
      cycle.take_column();
    }
    h += size;
  }
}

/// w ← w - Σ h_ij v_i with h_ij = v_i·w, twice; v_{j+1} = w/‖w‖. A w that vanishes leaves the zero vector or noise, of
/// which minimise() takes no heed.
void TensorGmres::orthogonalise_on_device(int64_t j, const at::Tensor& w) {
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
  if (!space_.in_loops()) take_columns_from_device();
  const auto batch = std::ssize(cycles_);
  const int64_t columns = v_.size(0);
  auto y = at::zeros({batch, columns, 1}, at::kDouble), exhausted = at::empty({batch}, at::kDouble);
  for (int64_t s = 0; s < batch; ++s) {
    auto& [problem, length, taken] = cycles_[s];
    problem.minimise(taken, length, 1.0);
    for (int64_t j = 0; j < taken; ++j)
      y.mutable_data_ptr<double>()[s * columns + j] = problem.inverse_length(j) == 0.0 ? 0.0 : problem.y(j);
    scale_[s] = problem.scale();
    exhausted.mutable_data_ptr<double>()[s] = problem.exhausted();
  }
  is_first_ = false;
  exhausted_ = exhausted;
  return y;
}

}  // namespace prdp
