#include "prdp/solvers/unnamed_null_space.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <cmath>

#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"

namespace prdp {

namespace {

at::Tensor norm_of_samples(const at::Tensor& v) { return v.to(at::kDouble).flatten(1).norm(2, 1); }

template <class T>
void add_shares(const at::Tensor& channels, std::vector<double>& shares) {
  const int64_t points = channels.size(2);
  const T* at = channels.const_data_ptr<T>();
  for (int64_t s = 0; s < channels.size(0); ++s) {
    double constant2 = 0.0, all2 = 0.0;
    for (int64_t c = 0; c < channels.size(1); ++c) {
      double sum = 0.0;
      for (int64_t i = 0; i < points; ++i, ++at) {
        const auto value = static_cast<double>(*at);
        sum += value;
        all2 += value * value;
      }
      constant2 += sum * sum;
    }
    shares.push_back(std::sqrt(constant2 / static_cast<double>(points) / all2));
  }
}

/// The share of each sample of v that is constant in a channel.
std::vector<double> constant_shares(const at::Tensor& v) {
  const auto channels = v.dim() < 3 ? v.unsqueeze(1) : v.flatten(2);
  std::vector<double> shares;
  if (!v.is_cpu()) {
    const auto constant = channels.to(at::kDouble).sum(2).norm(2, 1) / std::sqrt(static_cast<double>(channels.size(2)));
    const auto found = (constant / norm_of_samples(v)).to(at::kCPU);
    shares.assign(found.const_data_ptr<double>(), found.const_data_ptr<double>() + v.size(0));
  } else if (v.scalar_type() == at::kFloat) {
    add_shares<float>(channels.contiguous(), shares);
  } else {
    add_shares<double>(channels.contiguous(), shares);
  }
  return shares;
}

/// What an unsolved sample ended with.
struct Ended {
  double share_of_b, share_of_u, residual;  // relative
  int64_t products;
  bool stagnated;
};

/// Whether a null space that nobody named may be the reason, and the products that tell it are little beside those
/// spent, or u does not look like a truncated solution.
bool is_suspect(const Solver& solver, const Ended& s, double epsilon) {
  // No u takes the constant part of b off the residual. A half leaves room for rounding.
  if (!(s.share_of_b > 64.0 * epsilon && s.residual >= 0.5 * s.share_of_b)) return false;
  constexpr int64_t few = 32, many = 256;
  const auto& m = solver.preconditioner;
  if (traits(solver.method).is_direct || s.products >= many) return true;
  const bool has_cycles = solver.method == Method::kMultigrid || (m && !m.is_diagonal());
  if (s.products < few && !has_cycles) return false;
  return s.stagnated || s.residual > 1.0 || s.share_of_u > 0.9;
}

}  // namespace

at::Tensor maps_constant_to_zero(const Operator& a, const at::Tensor& b, bool transposed) {
  const auto product = [&](const at::Tensor& v) { return norm_of_samples(apply_on_loops(a, v, transposed)); };
  // How large a product can be: that of a vector which changes its sign from point to point.
  const auto alternating = 1.0 - 2.0 * at::arange(b[0].numel(), b.options()).remainder(2.0);
  const auto largest = product(alternating.view_as(b[0]).expand_as(b));
  return product(at::ones_like(b)) <= 16.0 * epsilon_of(b) * largest;
}

void find_inconsistent_constants(const Operator& a, const at::Tensor& b, const SolveRequest& request,
                                 SolveResult& result) {
  if (!request.guarded || !a.may_be_singular()) return;
  const auto& info = result.info;
  auto* status = info.status.mutable_data_ptr<int64_t>();
  const auto is_unsolved = [](int64_t s) {
    return s == static_cast<int64_t>(SolveStatus::kMaxIter) || s == static_cast<int64_t>(SolveStatus::kStagnated);
  };
  const int64_t batch = b.size(0);
  if (std::none_of(status, status + batch, is_unsolved)) return;

  const at::NoGradGuard no_grad;
  const auto of_b = constant_shares(b.detach()), of_u = constant_shares(result.u);
  const auto residual = info.residual.to(at::kCPU, at::kDouble);
  const auto* products = info.operator_applications.const_data_ptr<int64_t>();
  std::vector<int64_t> suspects;
  for (int64_t i = 0; i < batch; ++i) {
    if (!is_unsolved(status[i])) continue;
    const Ended ended{of_b[i], of_u[i], residual.const_data_ptr<double>()[i], products[i],
                      status[i] == static_cast<int64_t>(SolveStatus::kStagnated)};
    if (is_suspect(request.solver, ended, epsilon_of(b))) suspects.push_back(i);
  }
  if (suspects.empty()) return;
  const auto found = maps_constant_to_zero(a, b, /*transposed=*/true).to(at::kCPU);
  for (const int64_t i : suspects)
    if (found.const_data_ptr<bool>()[i]) status[i] = static_cast<int64_t>(SolveStatus::kInconsistent);
}

}  // namespace prdp
