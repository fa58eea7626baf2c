#include "prdp/autograd/misleading_derivatives.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <cmath>

#include "prdp/autograd/healthy_tensors.h"
#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"

namespace prdp {

bool may_mislead(const Solver& solver) { return !traits(solver.method).is_polynomial; }

Rows solved_samples(const Solved& solved) {
  const int64_t batch = solved.b.size(0);
  const auto counts = to_host<int64_t>(solved.iterations, batch), statuses = to_host<int64_t>(solved.status, batch);
  const auto residuals = to_host<double>(solved.residual, batch);
  Rows rows(batch);
  for (int64_t i = 0; i < batch; ++i) {
    const auto status = static_cast<SolveStatus>(statuses[i]);
    const bool left_little = status == SolveStatus::kMaxIter && residuals[i] <= std::sqrt(epsilon_of(solved.b));
    const bool met = status == SolveStatus::kConverged || status == SolveStatus::kStagnated || left_little;
    rows[i] = met && counts[i] > 0;
  }
  return rows;
}

std::vector<double> allowed_disagreement(const Solved& solved, const Solver& solver) {
  const int64_t batch = solved.b.size(0);
  const bool nears_breakdowns = traits(solver.method).nears_breakdowns;
  const auto residuals = to_host<double>(solved.residual, batch);
  const auto statuses = to_host<int64_t>(solved.status, batch);
  std::vector<double> allowed(batch, 1.0);  // no further than zero is
  for (int64_t i = 0; i < batch; ++i) {
    const double r = residuals[i];
    // Near a breakdown the recurrence amplifies rounding. Allowed is what the gradient of an iterate with residual r
    // may be off by, 10 √r, but 1e-3 at least and 1 at most.
    if (nears_breakdowns) allowed[i] = std::clamp(10.0 * std::sqrt(r), 1e-3, 1.0);
    // A loose tolerance lets the two differ by right: in one number of a field by 30 times at r = 0.2, by 9 at 0.01.
    // 1e4 r leaves room for that, and still finds rounding that iterations amplified, which is off by millions. Near a
    // breakdown rounding may be off by little more, so that there only r > 0.01 counts as loose.
    const bool is_loose =
        statuses[i] == static_cast<int64_t>(SolveStatus::kConverged) && (!nears_breakdowns || r > 0.01);
    if (is_loose) allowed[i] = std::max(allowed[i], 1e4 * r);
  }
  return allowed;
}

Rows misleading_b_bar(const Operator& a, const at::Tensor& cotangent, const at::Tensor& b_bar, const Rows& rows,
                      const std::vector<double>& allowed) {
  const at::NoGradGuard no_grad;
  const auto norm = [](const at::Tensor& v) { return to_host<double>(sample_norms(v), v.size(0)); };
  const auto product = apply_on_loops(a, b_bar.detach().contiguous(), /*transposed=*/true);
  const auto left = norm(a.project_solution(cotangent.detach() - product)), whole = norm(cotangent.detach());
  Rows misleading(rows.size());
  for (size_t i = 0; i < rows.size(); ++i)
    misleading[i] = rows[i] && (whole[i] > 0.0 ? left[i] / whole[i] : 0.0) > allowed[i];
  return misleading;
}

Rows misleading_a_bar(const OperatorSpec& spec, const std::vector<at::Tensor>& gradients, const at::Tensor& u,
                      at::IntArrayRef needed, const Rows& rows, const std::vector<double>& allowed) {
  const at::NoGradGuard no_grad;
  const auto batch = static_cast<int64_t>(rows.size());
  const auto allowed_of = at::tensor(allowed, at::kDouble).to(u.device());
  const auto healthy = with_healthy_tensors(spec, rows);
  const auto of_solution = make_operator(healthy)->product_rule(only(gradients[0].detach(), rows), only(u, rows));
  Rows misleading(batch);
  for (size_t k = 0; k < of_solution.size(); ++k) {
    if (!needed[k + 1] || !gradients[k + 1].defined() || !of_solution[k].defined()) continue;
    const auto in_double = at::promote_types(of_solution[k].scalar_type(), at::kDouble);
    const auto negated_implicit = of_solution[k].to(in_double), off = gradients[k + 1].detach() + negated_implicit;
    const bool of_samples = is_of_samples(spec, k, batch);
    const auto mark_by = [&](const auto& norm) {
      const auto is_misleading = norm(off).gt(allowed_of * norm(negated_implicit)).expand({batch}).contiguous();
      const auto judged = to_host<int64_t>(is_misleading.to(at::kLong), batch);
      for (int64_t i = 0; i < batch; ++i) misleading[i] = misleading[i] || (rows[i] && judged[i] != 0);
    };
    // By the numbers of each sample; by the whole tensor where samples share it; a Function may do either: by both.
    if (of_samples) mark_by([&](const at::Tensor& t) { return t.reshape({batch, -1}).norm(2, 1); });
    if (!of_samples || is_function(spec)) mark_by([](const at::Tensor& t) { return t.norm(); });
  }
  return misleading;
}

}  // namespace prdp
