#include "prdp/solvers/failure_messages.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <cmath>
#include <sstream>

#include "prdp/error_text.h"
#include "prdp/kernels/kernel.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/null_space_messages.h"
#include "prdp/solvers/unfit.h"
#include "prdp/solvers/unnamed_null_space.h"

namespace prdp {

namespace {

std::string name_of(const Solver& solver) {
  const auto& method = traits(solver.method);
  std::ostringstream text;
  text << method.label;
  if (method.counts == Counts::kCycles) text << "(" << solver.restart << ")";
  if (solver.method == Method::kMultigrid) return text.str();  // its cycles are its preconditioner
  if (solver.preconditioner.is_operator()) text << " with preconditioner " << solver.preconditioner.title();
  else if (solver.preconditioner)
    text << in_language(" with preconditioner=\"", " with Preconditioner::") << solver.preconditioner.title()
         << in_language("\"", "()");
  return text.str();
}

const char* precision_of(const at::Tensor& b) { return b.scalar_type() == at::kFloat ? "float32" : "float64"; }

double norm_of(const at::Tensor& v) { return v.to(at::kDouble).norm().item<double>(); }

double value_of_sample(const at::Tensor& t, int64_t sample) {
  return (t.dim() == 0 || t.size(0) == 1 ? t.reshape({-1})[0] : t.reshape({-1})[sample]).to(at::kDouble).item<double>();
}

/// Whether the product with a vector of ones is finite, for this sample.
bool is_finite(const Operator& a, const at::Tensor& b, int64_t sample) {
  return a.apply(at::ones_like(b)).select(0, sample).isfinite().all().item<bool>();
}

bool is_diffusion(const OperatorSpec& a) { return std::string_view(operator_kind(a.kind).title) == "Diffusion"; }

/// Where the rows of A, or its columns, differ so much in size that the dtype loses the small ones beside the large
/// ones: that, in words. Else empty.
std::string badly_scaled(const Solver& solver, const Operator& a, const at::Tensor& b, int64_t sample) {
  for (const bool columns : {false, true}) {
    const auto sizes = row_sizes(a, b, /*transposed=*/columns).select(0, sample);
    const auto there = sizes.masked_select(sizes.gt(0));
    if (there.numel() == 0) continue;
    const double spread = (there.max() / there.min()).item<double>();
    if (!(spread > 1.0 / (64.0 * epsilon_of(b)))) continue;
    const bool direct = traits(solver.method).is_direct, single = b.scalar_type() == at::kFloat;
    return std::string(direct ? "A is singular, or has " : "A has ") + "badly scaled " +
           (columns ? "columns" : "rows") + ": the largest is " + three_digits(spread) +
           " times the smallest, which is lost beside it; scale A and b" +
           (single   ? ", or take float64"
            : direct ? ""
                     : ", or take Direct");
  }
  return {};
}

/// Whether A maps constants to no more than the rounding of its entries, though not to zero: what holds u is lost.
bool row_sums_are_rounding(const Operator& a, const at::Tensor& b, int64_t sample) {
  const double row_sum = a.apply(at::ones_like(b)).select(0, sample).abs().max().item<double>();
  return row_sum > 0.0 && row_sum <= 64.0 * epsilon_of(b) * value_of_sample(a.norm(), sample);
}

/// Why a method for symmetric definite operators fails on this one.
std::string not_definite(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  if (b.scalar_type() == at::kFloat && row_sums_are_rounding(a, b, sample))
    return "what keeps A from being singular, such as its shift, is lost in the rounding of float32; take float64";
  if (auto found = asymmetric(role, a, b, sample); !found.empty()) return found;
  const bool single = b.scalar_type() == at::kFloat;
  return std::string("A is symmetric but not definite to ") + precision_of(b) +
         ": take MINRES if it is indefinite, name all its null vectors (nullspace) if it is singular, and take " +
         (single ? "float64" : "Direct") + " if it is ill-conditioned";
}

/// Where a preconditioner of the user's own hands out NaN or Inf: that, in words. Else empty.
std::string nonfinite_preconditioner(const Solver& solver, const at::Tensor& b, int64_t sample) {
  if (!solver.preconditioner.is_operator() || is_finite(*make_operator(solver.preconditioner.spec()), b, sample))
    return {};
  return "its preconditioner hands out NaN or Inf for a vector of ones; look at what M⁻¹ is made of";
}

/// Whether a preconditioner of the user's own hands out nothing.
bool maps_ones_to_zero(const Preconditioner& m, const at::Tensor& b, int64_t sample) {
  return m.is_operator() && !make_operator(m.spec())->apply(at::ones_like(b)).select(0, sample).any().item<bool>();
}

/// Why MINRES finds no direction.
std::string not_minimal(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  const auto& solver = role.solver;
  if (auto found = nonfinite_preconditioner(solver, b, sample); !found.empty()) return found;
  if (solver.preconditioner)
    return std::string(
               "v·M⁻¹ v is not positive for a vector v: its preconditioner is not positive definite, or A is "
               "singular") +
           (solver.preconditioner.is_operator() ? "" : "; take MINRES without it, or CG where A is negative definite");
  if (auto found = asymmetric(role, a, b, sample); !found.empty()) return found;
  return "A is singular, and b lies outside its range; take a b without that part";
}

std::string diverged(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  const auto& solver = role.solver;
  const auto made_for = traits(solver.method).made_for;
  if (made_for == MadeFor::kDominant)
    return "the residual grew beyond 1e13 ‖b‖, as an eigenvalue of I - D⁻¹A is larger than 1 in magnitude; take GMRES";
  if (made_for == MadeFor::kDefinite) return "the residual grew beyond ‖b‖: " + not_definite(role, a, b, sample);
  return "the residual grew beyond 1e13 ‖b‖; take GMRES with a larger restart, a preconditioner, or Direct";
}

std::string overflow(const Solver& solver, const Operator& a, const at::Tensor& b, int64_t sample) {
  if (auto found = nonfinite_preconditioner(solver, b, sample); !found.empty()) return found;
  if (solver.preconditioner && traits(solver.method).made_for == MadeFor::kSymmetric)
    return std::string("a number left the range of its dtype: its preconditioner may not be positive definite") +
           (solver.preconditioner.is_multigrid() ? ", as multigrid is not where A is not" : "") +
           "; take MINRES without it";
  const bool single = b.scalar_type() == at::kFloat;
  const double norm = value_of_sample(a.norm(), sample), norm_b = norm_of(b.select(0, sample));
  const bool known = norm > 0.0;  // not of a function
  if (!known && !is_finite(a, b, sample))
    return "A v is NaN or Inf for a vector v of ones; look at the state, the weights or the file that A is made of";
  return "a number left the range of " + std::string(precision_of(b)) + " (" +
         (known ? "‖A‖ is " + three_digits(norm) + ", " : "") + "‖b‖ is " +
         (std::isinf(norm_b) ? "above 1.8e+308" : three_digits(norm_b)) + "); " +
         (single ? "take float64, or scale A and b" : "scale A and b");
}

std::string breakdown(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  const auto& solver = role.solver;
  if (traits(solver.method).is_direct)
    return std::string("A is singular") +
           (b.scalar_type() == at::kFloat ? " to float32, or nearly so; take float64. If it is singular there, too,"
                                          : ";") +
           " GMRES solves it for any b in the range of A, and Direct where all null vectors are named";
  if (traits(solver.method).made_for == MadeFor::kDefinite && solver.preconditioner.is_operator())
    return std::string(
               "r·M⁻¹ r, or p·A p for a direction p, is zero or changes its sign: its preconditioner is not definite, "
               "or A is not") +
           in_language("; prdp.check_operator(A, b, solver) looks at both", "");
  if (traits(solver.method).made_for == MadeFor::kDefinite)
    return (solver.preconditioner ? "p·A p for a direction p is zero or changes its sign: "
                                  : "r·A r is zero for a residual r: ") +
           not_definite(role, a, b, sample);
  if (traits(solver.method).made_for == MadeFor::kSymmetric) return not_minimal(role, a, b, sample);
  if (maps_ones_to_zero(solver.preconditioner, b, sample))
    return "its preconditioner maps a vector of ones to zero; look at what M⁻¹ is made of";
  if (traits(solver.method).counts == Counts::kIterations) return "r·A r is zero for a residual r; take GMRES";
  const bool single = b.scalar_type() == at::kFloat;
  return std::string(
             "its space is exhausted and does not hold the solution: A is singular, and b lies outside its range, or A "
             "is too ill-conditioned for ") +
         (single ? "float32; take float64 to tell, or" : "float64; if it is singular, take") + " a b without that part";
}

/// Why the factors of a diffusion lose what `Direct` needs of it (Kernel::has_definite_factors), in words. Else empty.
std::string lost_in_factors(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  // Of a singular one nothing holds u.
  if (!traits(role.solver.method).is_direct || !is_diffusion(role.a) || is_singular(role.a)) return {};
  const auto of = [&](const at::Tensor& t) { return t.expand_as(b).select(0, sample).to(at::kDouble).abs(); };
  const auto diagonal = of(a.diagonal()), row_sums = of(a.apply(at::ones_like(b)));
  if ((diagonal.max() / diagonal.min()).item<double>() >= kernels::kWidestRowsOfFactors)
    return "κ differs by more than a factor of 1e13, beyond what factors in float64 hold; bring its largest and its "
           "smallest value nearer to each other";
  if ((diagonal.sum() / row_sums.sum()).item<double>() >= kernels::kWidestRowsOfFactors)
    return "what holds u, a shift or the sides, is 1e13 times smaller than κ/dx², beyond what factors in float64 hold; "
           "make κ smaller or the shift larger";
  return {};
}

/// Why the residual fell no further, far above what was asked for.
std::string stagnated(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  const auto& solver = role.solver;
  if (auto found = unfit(role, a, b, sample); !found.empty()) return found;
  const bool single = b.scalar_type() == at::kFloat;
  if (single && is_diffusion(role.a) && solver.method == Method::kConjugateGradient)
    return "the residual falls no further in float32; where κ jumps or little holds u, u may be right all the same: "
           "solve it once in float64 to see, and if it is, stay there";
  if (traits(solver.method).counts == Counts::kCycles)
    return "its cycles take nothing more off the residual; take a larger restart, " +
           std::string(solver.preconditioner.is_multigrid() ? "no multigrid" : "a preconditioner") + ", or Direct" +
           (single ? ", or float64" : "");
  const std::string others = solver.method == Method::kDirect ? "take an iterative method"
                             : solver.preconditioner.is_multigrid()
                                 ? "take another preconditioner than multigrid, or Direct"
                                 : "take another preconditioner or Direct";
  return "the residual falls no further in " + std::string(precision_of(b)) + ", and u may be wrong; " +
         (single ? "solve it in float64 once to see, and if it is, stay there, or " : "") + others +
         ", or scale A and b so that their rows are of one size";
}

/// Why max_iter left a large residual.
std::string stopped(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  const auto& solver = role.solver;
  if (auto found = unfit(role, a, b, sample); !found.empty()) return found;
  const bool holds_weakly = is_diffusion(role.a) && b.scalar_type() == at::kFloat;
  if (solver.preconditioner.is_multigrid() && holds_weakly && solver.method != Method::kConjugateGradient)
    return "in float32 its coarse grids may lose what keeps A from being singular; take CG with multigrid, Direct or "
           "float64";
  if (solver.preconditioner.is_multigrid())
    return "its cycles may not be made for this A, as for a wind in central differences that is strong beside the "
           "diffusion; take upwind differences, leave out multigrid, or take Direct";
  if (traits(solver.method).is_direct)
    return "its residual is above the rounding of a product, though u may be right; " +
           std::string(b.scalar_type() == at::kFloat ? "solve it in float64 once to see" : "scale A and b") +
           ", or refine it by a larger max_iter";
  return "take more iterations, a preconditioner, GMRES or Direct";
}

/// Whether the method solves systems whose diagonal has zeros, or both signs.
bool takes_any_diagonal(Method method) {
  const auto made_for = traits(method).made_for;
  return made_for == MadeFor::kAny || made_for == MadeFor::kSymmetric;
}

std::string zero_diagonal(const SolveRole& role, const Operator& a, const at::Tensor& b, int64_t sample) {
  const bool has_zero = a.diagonal().expand_as(b).select(0, sample).eq(0).any().item<bool>();
  const std::string why = operator_kind(role.a.kind).has_pressure ? "the pressure rows have a zero diagonal"
                          : has_zero ? "it divides by the diagonal of A, which has a zero there"
                                     : "multigrid finds no coarse grid for A: a diagonal vanishes, or a number leaves "
                                       "the range of the dtype, on one of them";
  return why + (role.solver.preconditioner.is_diagonal() && takes_any_diagonal(role.solver.method)
                    ? "; take " + std::string(traits(role.solver.method).label) + " without it"
                    : "; take GMRES");
}

}  // namespace

std::string diagnosis(const SolveRole& role, const Operator& a, const at::Tensor& b, SolveStatus status,
                      int64_t sample) {
  const at::NoGradGuard no_grad;
  const auto why = [&]() -> std::string {
    if (status == SolveStatus::kDiverged || status == SolveStatus::kBreakdown)
      if (auto unnamed = undeclared_null_space(role, a, b, sample); !unnamed.empty()) return unnamed;
    if (status == SolveStatus::kBreakdown)
      if (auto lost = lost_in_factors(role, a, b, sample); !lost.empty()) return lost;
    if (status == SolveStatus::kDiverged || status == SolveStatus::kBreakdown || status == SolveStatus::kStagnated)
      if (auto scales = badly_scaled(role.solver, a, b, sample); !scales.empty()) return scales;
    switch (status) {
      case SolveStatus::kDiverged: return diverged(role, a, b, sample);
      case SolveStatus::kOverflow: return overflow(role.solver, a, b, sample);
      case SolveStatus::kBreakdown: return breakdown(role, a, b, sample);
      case SolveStatus::kZeroDiagonal: return zero_diagonal(role, a, b, sample);
      case SolveStatus::kInconsistent: return inconsistent(role, a, b, sample);
      case SolveStatus::kNonfiniteInput:
        if (!b.select(0, sample).isfinite().all().item<bool>())
          return role.adjoint
                     ? "the cotangent is NaN or Inf there; look at the loss, at the scale of a GradScaler, or at the "
                       "steps after this one"
                     : "the right-hand side is NaN or Inf there; look at the state that it is made of";
        return "the start is NaN or Inf there; take another one, or none";
      case SolveStatus::kNonfiniteOperator:
        if (const auto refused = a.refusal(sample); !refused.empty())
          return refused + "; what a network predicts should end in exp or softplus";
        return "A is made of a NaN or Inf; look at the state, the weights or the file that it comes from";
      case SolveStatus::kStagnated: return stagnated(role, a, b, sample);
      case SolveStatus::kMaxIter: return stopped(role, a, b, sample);
      default: return "it did not reach its tolerance; raise max_iter or rtol";
    }
  }();
  return name_of(role.solver) + " on " + operator_kind(role.a.kind).title + ": " + why;
}

}  // namespace prdp
