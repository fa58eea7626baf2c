#include "prdp/solvers/uneven_rows.h"

#include <ATen/core/grad_mode.h>
#include <c10/util/hash.h>

#include <algorithm>
#include <bit>

#include "prdp/error_text.h"
#include "prdp/gpu/runtime.h"
#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/probes.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/unnamed_null_space.h"
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
at::Tensor shares_of_error(const at::Tensor& rows, const at::Tensor& b, const at::Tensor& u,
                           const at::Tensor& residual) {
  constexpr double much_larger = 10.0;
  const auto left = residual.abs().to(at::kDouble);
  const auto largest = per_sample(sample_maxima(rows), b), size = per_sample(sample_maxima(u), b);
  const auto tells = rows.gt(0) & (rows * much_larger).lt(largest) & size.gt(0);
  return at::where(tells, left / (rows * size), 0.0);
}

/// How much larger the largest row of a sample is than its small ones, of those that are not zero; the largest of all
/// samples. A thousandth of the rows is left out: estimates of so many are too small for some.
double spread_of(const at::Tensor& rows) {
  const auto of_samples = rows.flatten(1);
  const auto there = of_samples.masked_fill(of_samples.le(0), std::numeric_limits<double>::infinity());
  const auto small = std::get<0>(there.kthvalue(1 + of_samples.size(1) / 1000, 1));
  return at::where(small.isinf(), 1.0, of_samples.amax(1) / small).max().item<double>();
}

/// Rows of these differ at the boundary alone: there is no need to look.
bool has_even_rows(const OperatorSpec& a) { return a.kind == "poisson" || a.kind == "heat"; }

/// Whether b has channels that A takes apart.
bool has_channels_apart(const OperatorSpec& a, const at::Tensor& b) {
  const bool couples = a.kind == "burgers" || a.kind == "navier_stokes" || is_function(a);
  return !couples && b.dim() > 2 && b.size(1) > 1;
}

/// Where the solve with `role` had the `residual` b - A u.
struct Look {
  const SolveRole& role;
  const at::Tensor &b, &u, &residual;
  at::Tensor converged;

  std::string beginning(int64_t sample) const {
    return c10::str(role.adjoint ? "adjoint solve" : "linear_solve", ": sample ", sample,
                    " CONVERGED to rtol = ", role.solver.rtol, ", but ");
  }
  std::string key(const char* what) const { return c10::str(what, role.a.kind, role.adjoint, b.sizes().slice(1)); }
  double much() const { return std::max(1e-3, 100.0 * role.solver.rtol); }
};

void warn_of_small_channels(const Look& look) {
  const auto norms = [](const at::Tensor& v) { return v.flatten(2).norm(2, 2, /*keepdim=*/false, at::kDouble); };
  const auto of_b = norms(look.b), of_all = of_b.amax(1, /*keepdim=*/true);
  const auto is_there = of_b > 100.0 * epsilon_of(look.b) * of_all;  // less is rounding
  const auto shares =
      at::where(is_there, norms(look.residual) / of_b, 0.0).masked_fill(look.converged.logical_not().unsqueeze(1), 0.0);
  const auto worst = shares.argmax().item<int64_t>(), channels = shares.size(1);
  const double share = shares.flatten()[worst].item<double>();
  const double much = std::max(0.05, 3.0 * look.role.solver.rtol);  // of equal channels some end just above rtol
  if (!(share > much)) return;
  warn_once(look.key("small channels"), share, [&](std::ostream& text) {
    text << look.beginning(worst / channels) << "in channel " << worst % channels << " alone |b - A u| is "
         << three_digits(share) << " |b|: its b is much smaller than that of another channel, and all channels have "
         << "one stopping test. Make the channels samples, of b and of A, or take "
         << in_language("Direct()", "Direct{}");
  });
}

/// A of `spec` in float64, each of its numbers changed by the share `rounding` at most.
OperatorSpec in_double(OperatorSpec spec, double rounding) {
  for (auto& t : spec.tensors) {
    if (!at::isFloatingType(t.scalar_type())) continue;
    t = t.to(at::kDouble);
    if (rounding > 0.0) t = t * (1.0 + rounding * unstructured_like(t.unsqueeze(0)).squeeze(0));
  }
  return spec;
}

/// The solver of `look`, for a residual that is much smaller than the one it left, by no more than about twice as many
/// products.
Solver to_go_on(const Look& look, const SolveInfo& info) {
  auto solver = look.role.solver;
  solver.rtol = 1e-4;
  const int64_t products = 2 * info.operator_applications.max().item<int64_t>() + 20;
  const auto& method = traits(solver.method);
  const int64_t each = method.counts == Counts::kCycles ? solver.restart : method.products;
  solver.max_iter = (products + each - 1) / each;
  return solver;
}

/// How far u changes by a solve for its error, as a share of its largest entry then. Where the rounding of A itself
/// moves u as far, as along a null vector that nobody named, that says nothing: 0.
at::Tensor changes_by_more_iterations(const Look& look, const Operator& a, const SolveInfo& info) {
  const auto solver = to_go_on(look, info);
  const auto u = look.u.to(at::kDouble);
  const auto exact = make_operator(in_double(look.role.a, 0.0));
  const auto change_by = [&](const Operator& of, const at::Tensor& part_of_b) {
    return solve(of, of.project(part_of_b), {.solver = solver}).u.to(at::kDouble);
  };
  const auto product = apply_on_loops(*exact, u, /*transposed=*/false);
  const auto change = change_by(a, (look.b.to(at::kDouble) - product).to(look.b.scalar_type()));
  auto changes = (change.abs() / per_sample(sample_maxima(u + change), u)).nan_to_num(0.0, 0.0, 0.0);
  if (!(changes.max() > look.much()).item<bool>()) return changes;
  const bool keeps_null_space = look.role.a.kind == "singular_diffusion";  // the constant, whatever κ
  auto is_free = keeps_null_space ? at::zeros({u.size(0)}, at::kBool)
                                  : maps_constant_to_zero(a, look.b, /*transposed=*/false, /*jointly=*/true);
  if (keeps_null_space || !is_singular(look.role.a)) {
    const auto rounded = make_operator(in_double(look.role.a, epsilon_of(look.b)));
    const auto moved = change_by(*exact, apply_on_loops(*rounded, u, /*transposed=*/false) - product);
    is_free = is_free.logical_or(sample_maxima(moved) > 0.3 * sample_maxima(change));
  }
  return changes.masked_fill(per_sample(is_free, u), 0.0);
}

void warn_of_small_rows(const Look& look, const Operator& a, const SolveInfo& info) {
  constexpr double wide = 30.0;
  const double rtol = look.role.solver.rtol;
  const auto rows = size_of_rows(a, look.b).to(at::kDouble);
  auto shares = shares_of_error(rows, look.b, look.u, look.residual);
  const double spread = spread_of(rows);
  if (spread > wide && look.much() < 1.0 && !look.role.solver.preconditioner.is_operator())
    shares = at::maximum(shares, changes_by_more_iterations(look, a, info));
  const auto worst_of = shares.flatten(1).amax(1).masked_fill(look.converged.logical_not(), 0.0);
  const auto i = worst_of.argmax().item<int64_t>();
  const double worst = worst_of[i].item<double>();
  if (!(worst > look.much())) return;
  const bool adjoint = look.role.adjoint;
  warn_once(look.key("uneven rows "), worst, [&](std::ostream& text) {
    const auto place = shares[i].eq(worst);
    text << look.beginning(i) << (adjoint ? "its solution, which the gradient is made of," : "u")
         << " is off by at least about " << three_digits(100.0 * worst) << " % of its largest entry at index "
         << as_tuple(first_true(place));
    if (const auto others = worst_of.gt(look.much()).sum().item<int64_t>() - 1; others > 0)
      text << " (and those of " << others << " other sample" << (others > 1 ? "s" : "") << " by more than "
           << three_digits(100.0 * look.much()) << " %)";
    text << ": some rows of A, such as those of a penalty or where a coefficient is large, are up to "
         << three_digits(spread) << " times as large as others, and a residual beside them tells little of these. Take "
         << in_language("Direct()", "Direct{}");
    const double enough = rtol * (rtol / worst);  // the error falls with rtol, here to about rtol
    constexpr double least_in_double = 1e-13;
    if (enough < least_in_double) return;
    text << " or a smaller " << (adjoint ? "adjoint_rtol" : "rtol") << ", such as " << three_digits(enough);
    if (enough < 100.0 * epsilon_of(look.b)) text << "; in float32 that ends STAGNATED, at the rounding of each row";
  });
}

}  // namespace

void warn_of_uneven_rows(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveResult& result,
                         bool looks_at_channels) {
  const auto& solver = role.solver;
  const bool looks_at_rows = !is_function(role.a) && !has_even_rows(role.a);
  looks_at_channels = looks_at_channels && !role.adjoint && has_channels_apart(role.a, b);
  if (!(solver.rtol > 0.0) || traits(solver.method).is_direct || (!looks_at_rows && !looks_at_channels)) return;
  if (!b.is_cpu() || gpu::runtime_of(b.device()) || b.numel() == 0 || !is_plain(b) || !all_plain(role.a.tensors))
    return;
  // Systems of another kind, such as those of a contact that begins, take another number of iterations.
  const auto order = std::bit_width(static_cast<uint64_t>(result.info.iterations.max().item<int64_t>()));
  if (!should_look(
          c10::get_hash(role.a.kind, role.adjoint, static_cast<int>(solver.method), order, b.sizes().slice(1).vec())))
    return;
  const at::NoGradGuard no_grad;
  const auto& status = result.info.status;
  const auto is = [&](SolveStatus of) { return status.eq(static_cast<int64_t>(of)); };
  const auto converged = is(SolveStatus::kConverged).logical_or(is(SolveStatus::kConvergedBreakdown));
  if (!converged.any().item<bool>()) return;
  const auto residual = a.project(b - apply_on_loops(a, result.u, /*transposed=*/false));
  const Look look{role, b, result.u, residual, converged};
  if (looks_at_channels) warn_of_small_channels(look);
  if (looks_at_rows) warn_of_small_rows(look, a, result.info);
}

}  // namespace prdp
