#include "prdp/solvers/uneven_rows.h"

#include <ATen/core/grad_mode.h>
#include <c10/util/hash.h>

#include <algorithm>

#include "prdp/error_text.h"
#include "prdp/gpu/runtime.h"
#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/probes.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

namespace {

/// Estimates the norm of each row of A by its largest product with a few vectors of no structure: enough that none of
/// thousands of rows is nearly orthogonal to all of them.
at::Tensor size_of_rows(const Operator& a, const at::Tensor& like) {
  constexpr int64_t vectors = 4;
  auto v = unstructured_like(like), largest = apply_on_loops(a, v, /*transposed=*/false).abs();
  for (int64_t k = 1; k < vectors; ++k) {
    v = v.flatten(1).roll(1, 1).view_as(v);
    largest = at::maximum(largest, apply_on_loops(a, v, /*transposed=*/false).abs());
  }
  return largest;
}

/// An approximate lower bound of the error at each point of a small row, as a share of the largest |u|:
/// |r_i| / (‖a_i‖ max |u|).
at::Tensor shares_of_error(const Operator& a, const at::Tensor& b, const at::Tensor& u) {
  constexpr double much_larger = 10.0;
  const auto left = a.project(b - apply_on_loops(a, u, /*transposed=*/false)).abs().to(at::kDouble);
  const auto rows = size_of_rows(a, b).to(at::kDouble);
  const auto largest = per_sample(sample_maxima(rows), b), size = per_sample(sample_maxima(u), b);
  const auto tells = rows.gt(0) & (rows * much_larger).lt(largest) & size.gt(0);
  return at::where(tells, left / (rows * size), 0.0);
}

/// Rows of these differ at the boundary alone: there is no need to look.
bool has_even_rows(const OperatorSpec& a) { return a.kind == "poisson" || a.kind == "heat"; }

}  // namespace

void warn_of_uneven_rows(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveResult& result) {
  const auto& solver = role.solver;
  const double rtol = solver.rtol;
  if (!(rtol > 0.0) || traits(solver.method).is_direct || is_function(role.a) || has_even_rows(role.a)) return;
  if (!b.is_cpu() || gpu::runtime_of(b.device()) || b.numel() == 0 || !is_plain(b) || !all_plain(role.a.tensors))
    return;
  if (!should_look(c10::get_hash(role.a.kind, role.adjoint, static_cast<int>(solver.method), b.sizes().slice(1).vec())))
    return;
  const at::NoGradGuard no_grad;
  const auto converged = result.info.status.eq(static_cast<int64_t>(SolveStatus::kConverged));
  const auto shares = shares_of_error(a, b, result.u);
  const auto worst_of = shares.flatten(1).amax(1).masked_fill(converged.logical_not(), 0.0);
  const auto i = worst_of.argmax().item<int64_t>();
  const double worst = worst_of[i].item<double>();
  if (!(worst > std::max(1e-3, 100.0 * rtol))) return;
  std::ostringstream key;
  key << "uneven rows " << role.a.kind << role.adjoint << b.sizes().slice(1);
  warn_once(key.str(), worst, [&](std::ostream& text) {
    const auto place = shares[i].eq(worst);
    text << (role.adjoint ? "adjoint solve" : "linear_solve") << ": sample " << i << " CONVERGED to rtol = " << rtol
         << ", but u is off by at least about " << three_digits(100.0 * worst) << " % of its largest entry at index "
         << as_tuple(first_true(place))
         << ": other rows of A, such as those of a penalty, are much larger and make up ‖b‖. Take "
         << in_language("Direct()", "Direct{}");
    const double enough = rtol * (rtol / worst);  // the error falls with rtol, here to about rtol
    if (enough > 100.0 * epsilon_of(b)) text << " or a smaller rtol, such as " << three_digits(enough);
  });
}

}  // namespace prdp
