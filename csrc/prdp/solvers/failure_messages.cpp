#include "prdp/solvers/failure_messages.h"

#include <ATen/core/grad_mode.h>

#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/probes.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/null_space_messages.h"
#include "prdp/solvers/operator_messages.h"
#include "prdp/solvers/unfit.h"

namespace prdp {

namespace {

/// "GMRES(20) with preconditioner="jacobi"".
std::string name_of(const Solver& solver) {
  const auto& method = traits(solver.method);
  std::string name(method.label);
  if (method.counts == Counts::kCycles) name += c10::str("(", solver.restart, ")");
  const auto& preconditioner = solver.preconditioner;
  if (!preconditioner || solver.method == Method::kMultigrid) return name;  // its cycles are its preconditioner
  if (preconditioner.is_operator()) return c10::str(name, " with preconditioner ", preconditioner.title());
  return c10::str(name, in_language(" with preconditioner=\"", " with Preconditioner::"), preconditioner.title(),
                  in_language("\"", "()"));
}

bool all_finite(const at::Tensor& t) { return t.isfinite().all().item<bool>(); }

/// M⁻¹ times a vector of ones, of a preconditioner of the user's own; undefined for others.
at::Tensor preconditioned_ones(const FailedSample& sample) {
  if (!sample.preconditioner().is_operator()) return {};
  return sample.of(make_operator(sample.preconditioner().spec())->apply(at::ones_like(sample.b)));
}

/// ‖A‖ of the sample; zero if nobody knows it, as of a function.
double operator_norm(const FailedSample& sample) {
  const auto norm = sample.a.norm();
  const bool is_shared = norm.numel() == 1;
  return norm.reshape({-1})[is_shared ? 0 : sample.index].to(at::kDouble).item<double>();
}

/// A preconditioner of the user's own hands out NaN or Inf.
std::string nonfinite_preconditioner(const FailedSample& sample) {
  const auto m = preconditioned_ones(sample);
  if (!m.defined() || all_finite(m)) return {};
  return "its preconditioner hands out NaN or Inf for a vector of ones; look at what M⁻¹ is made of";
}

/// Whether A maps constants to no more than the rounding of its entries, though not to zero: what holds u is lost.
bool row_sums_are_rounding(const FailedSample& sample) {
  const double row_sum = sample.row_sums().abs().max().item<double>();
  return row_sum > 0.0 && row_sum <= 64.0 * epsilon_of(sample.b) * operator_norm(sample);
}

/// Whether a preconditioner of the user's own hands out nothing.
bool maps_ones_to_zero(const FailedSample& sample) {
  const auto m = preconditioned_ones(sample);
  return m.defined() && !m.any().item<bool>();
}

const char* how_to_name() { return in_language(" (nullspace)", " (prdp::with_null_space)"); }

/// Why a method for symmetric definite operators fails on this one.
std::string not_definite(const FailedSample& sample) {
  if (sample.is_single() && row_sums_are_rounding(sample))
    return "what keeps A from being singular, such as its shift, is lost in the rounding of float32; take float64";
  if (auto found = asymmetric(sample); !found.empty()) return found;
  return c10::str("A is symmetric but not definite to ", sample.precision(),
                  ": take MINRES if it is indefinite, name all its null vectors", how_to_name(),
                  " if it is singular, and take ", sample.is_single() ? "float64" : "Direct",
                  " if it is ill-conditioned");
}

/// Why MINRES finds no direction.
std::string minres_breakdown(const FailedSample& sample) {
  if (auto found = nonfinite_preconditioner(sample); !found.empty()) return found;
  if (sample.preconditioner())
    return c10::str(
        "v·M⁻¹ v is not positive for a vector v: its preconditioner is not positive definite, or A is "
        "singular",
        sample.preconditioner().is_operator() ? "" : "; take MINRES without it, or CG where A is negative definite");
  if (auto found = asymmetric(sample); !found.empty()) return found;
  return "A is singular, and b lies outside its range; take a b without that part";
}

std::string if_singular() { return c10::str(". If A is singular, name all its null vectors", how_to_name()); }
constexpr const char* kLostCoarseGrids =
    "in float32 its coarse grids may lose what keeps A from being singular; take CG with multigrid, Direct or float64";

bool loses_coarse_grids(const FailedSample& sample) {
  const auto method = sample.solver().method;
  return sample.is_single() && sample.is_diffusion() && method != Method::kConjugateGradient &&
         (method == Method::kMultigrid || sample.preconditioner().is_multigrid());
}

/// Methods that ask less of A than the one that failed.
const char* weaker_methods(const FailedSample& sample) {
  return is_symmetric(sample) ? "CG if A is positive definite, else MINRES" : "GMRES";
}

// One function for each status.

/// Why iterates run away, and what to do, after a statement of what they did.
std::string why_iterates_grow(const FailedSample& sample) {
  switch (sample.method().made_for) {
    case MadeFor::kDominant:
      return c10::str(", as an eigenvalue of I - D⁻¹A is larger than 1 in magnitude; take ", weaker_methods(sample));
    case MadeFor::kDefinite: return ": " + not_definite(sample);
    default:
      if (loses_coarse_grids(sample)) return c10::str(": ", kLostCoarseGrids);
      return "; take GMRES with a larger restart, a preconditioner, or Direct" + if_singular();
  }
}

std::string diverged(const FailedSample& sample) {
  const bool may_grow_to_b = sample.method().made_for == MadeFor::kDefinite;
  return c10::str("the residual grew beyond ", may_grow_to_b ? "" : "1e13 ", "‖b‖", why_iterates_grow(sample));
}

std::string overflow(const FailedSample& sample) {
  if (auto found = nonfinite_preconditioner(sample); !found.empty()) return found;
  if (sample.preconditioner() && sample.method().made_for == MadeFor::kSymmetric)
    return c10::str("a number left the range of its dtype: its preconditioner may not be positive definite",
                    sample.preconditioner().is_multigrid() ? ", as multigrid is not where A is not" : "",
                    "; take MINRES without it");
  const double norm = operator_norm(sample), norm_b = norm_of(sample.of(sample.b));
  if (!(norm > 0.0) && !all_finite(sample.row_sums()))
    return "A v is NaN or Inf for a vector v of ones; look at the state, the weights or the file that A is made of";
  if (sample.role.unrolled)
    return c10::str("a number left the range of ", sample.precision(), " in the derivative of the iterations; take ",
                    in_language("backward=\"implicit\"", "Backward::kImplicit"), ", which does not differentiate them");
  const auto sizes = (norm > 0.0 ? "‖A‖ is " + three_digits(norm) + ", " : "") + "‖b‖ is " +
                     (std::isinf(norm_b) ? "above 1.8e+308" : three_digits(norm_b));
  const auto is_moderate = [](double n) { return n > 1e-12 && n < 1e12; };  // far from the limits of any dtype
  if (!sample.method().is_direct && is_moderate(norm) && is_moderate(norm_b))
    return c10::str("the iterates grew beyond the range of ", sample.precision(), " (", sizes, ")",
                    why_iterates_grow(sample));
  return c10::str("a number left the range of ", sample.precision(), " (", sizes, "); ",
                  sample.is_single() ? "take float64, or scale A and b" : "scale A and b");
}

std::string direct_breakdown(const FailedSample& sample) {
  return c10::str("A is singular to ", sample.precision(), ", or nearly so; ",
                  sample.is_single() ? "take float64; if it is singular there, too, " : "",
                  "GMRES solves it for any b in the range of A, and Direct where all null vectors are named");
}

std::string definite_breakdown(const FailedSample& sample) {
  if (sample.preconditioner().is_operator())
    return c10::str(
        "r·M⁻¹ r, or p·A p for a direction p, is zero or changes its sign: its preconditioner is not "
        "definite, or A is not",
        in_language("; prdp.check_operator(A, b, solver) looks at both", ""));
  const char* what = sample.preconditioner() ? "p·A p for a direction p is zero or changes its sign: "
                                             : "r·A r is zero for a residual r: ";
  return what + not_definite(sample);
}

std::string breakdown(const FailedSample& sample) {
  if (sample.method().is_direct) return direct_breakdown(sample);
  if (sample.method().made_for == MadeFor::kDefinite) return definite_breakdown(sample);
  if (sample.method().made_for == MadeFor::kSymmetric) return minres_breakdown(sample);
  if (maps_ones_to_zero(sample)) return "its preconditioner maps a vector of ones to zero; look at what M⁻¹ is made of";
  if (sample.method().counts == Counts::kIterations)
    return c10::str("r·A r is zero for a residual r, or u grew without end; take ", weaker_methods(sample));
  if (is_singular(sample.role.a))
    return c10::str(
        "its space is exhausted and does not hold the solution: A has a null vector that was not named, or is "
        "too ill-conditioned for ",
        sample.precision(), "; take BiCGStab or Direct");
  const char* remedy = sample.is_single() ? "float32; take float64 to tell, or" : "float64; if it is singular, take";
  return c10::str(
      "its space is exhausted and does not hold the solution: A is singular, and b lies outside its range, "
      "or A is too ill-conditioned for ",
      remedy, " a b without that part");
}

/// Whether the residual of u is its rounding for long, where κ jumps or little holds u.
bool is_diffusion_in_single(const FailedSample& sample) {
  return sample.is_single() && sample.is_diffusion() && sample.solver().method == Method::kConjugateGradient;
}
constexpr const char* kMayBeRight =
    "the residual falls no further in float32; where κ jumps or little holds u, u may be right all the same: solve it "
    "once in float64 to see, and if it is, stay there";

/// Why the residual fell no further, far above what was asked for.
std::string stagnated(const FailedSample& sample) {
  if (auto found = unfit(sample); !found.empty()) return found;
  const bool single = sample.is_single(), multigrid = sample.preconditioner().is_multigrid();
  const auto method = sample.solver().method;
  if (is_diffusion_in_single(sample)) return kMayBeRight;
  if (sample.method().counts == Counts::kCycles)
    return c10::str("its cycles take nothing more off the residual; take a larger restart, BiCGStab, ",
                    multigrid ? "no multigrid" : "a preconditioner", ", or Direct", single ? ", or float64" : "",
                    if_singular());
  const char* another = method == Method::kDirect ? "take an iterative method"
                        : multigrid               ? "take another preconditioner than multigrid, or Direct"
                        : sample.preconditioner() ? "take another preconditioner, or Direct"
                                                  : "take a preconditioner, or Direct";
  return c10::str("the residual falls no further in ", sample.precision(), ", and u may be wrong; ",
                  single ? "solve it in float64 once to see, and if it is, stay there, or " : "", another,
                  ", or scale A and b so that their rows are of one size");
}

/// Why max_iter left a large residual.
std::string max_iter_reached(const FailedSample& sample) {
  if (auto found = unfit(sample); !found.empty()) return found;
  const bool single = sample.is_single();
  if (loses_coarse_grids(sample)) return kLostCoarseGrids;
  const bool were_many = sample.solver().max_iter.expect_int() >= 100;
  if (were_many && is_diffusion_in_single(sample) && !sample.preconditioner().is_multigrid())
    return c10::str("more iterations may help, or ", kMayBeRight);
  if (sample.preconditioner().is_multigrid() && asymmetric(sample).empty())
    return "its cycles are slow where coefficients jump from cell to cell; take more iterations, \"diagonal\" or "
           "Direct";
  if (sample.preconditioner().is_multigrid())
    return c10::str(
        "its cycles may not be made for this A, as for a wind in central differences or species whose coupling is "
        "strong "
        "beside the diffusion; take upwind differences, ",
        sample.method().counts == Counts::kCycles ? "BiCGStab, a larger restart, " : "", "no multigrid, or Direct");
  if (sample.method().is_direct)
    return c10::str("its residual is above the rounding of a product, though u may be right; ",
                    single ? "solve it in float64 once to see" : "scale A and b",
                    ", or refine it by a larger max_iter");
  if (sample.method().made_for == MadeFor::kSymmetric)
    return c10::str("take CG if A is positive definite; else more iterations, a preconditioner",
                    single ? ", float64" : "", " or Direct");
  if (sample.method().counts == Counts::kCycles) return "take a larger restart, a preconditioner, or Direct";
  if (sample.method().made_for == MadeFor::kDominant)
    return c10::str("take more iterations if its diagonal dominates A, else ", weaker_methods(sample));
  return "take more iterations, a preconditioner, GMRES or Direct";
}

const char* zero_on_diagonal(const FailedSample& sample) {
  if (sample.has_pressure()) return "the pressure rows have a zero diagonal";
  if (sample.of(sample.a.diagonal()).eq(0).any().item<bool>())
    return "it divides by the diagonal of A, which has a zero there";
  if (sample.preconditioner().is_multigrid() || sample.solver().method == Method::kMultigrid)
    return "multigrid finds no coarse grid for A: on one of them a diagonal vanishes, or a number leaves the range of "
           "the dtype";
  return "it divides by the diagonal of A, whose least number is lost beside the largest";
}

std::string zero_diagonal(const FailedSample& sample) {
  const auto made_for = sample.method().made_for;
  const bool takes_any_diagonal =
      made_for == MadeFor::kAny || (made_for == MadeFor::kSymmetric && asymmetric(sample).empty());
  const bool is_to_blame = sample.preconditioner().is_diagonal() && takes_any_diagonal;
  const char* another = is_symmetric(sample) ? "MINRES" : "GMRES";
  return c10::str(zero_on_diagonal(sample), "; take ", is_to_blame ? sample.method().label : another,
                  is_to_blame ? " without it" : "");
}

std::string nonfinite_input(const FailedSample& sample) {
  if (all_finite(sample.of(sample.b))) return "the start is NaN or Inf there; take another one, or none";
  if (sample.role.adjoint)
    return "the cotangent is NaN or Inf there; look at the loss" +
           std::string(in_language(", at the scale of a GradScaler,", "")) + " or at the steps after this one";
  return "the right-hand side is NaN or Inf there; look at the state that it is made of";
}

std::string nonfinite_operator(const FailedSample& sample) {
  if (auto refused = sample.a.refusal(sample.index); !refused.empty()) return refused;
  return "A is made of a NaN or Inf; look at the state, the weights or the file that it comes from";
}

std::string cause_of(const FailedSample& sample, SolveStatus status) {
  if (auto found = cause_in_operator(sample, status); !found.empty()) return found;
  switch (status) {
    case SolveStatus::kDiverged: return diverged(sample);
    case SolveStatus::kOverflow: return overflow(sample);
    case SolveStatus::kBreakdown: return breakdown(sample);
    case SolveStatus::kZeroDiagonal: return zero_diagonal(sample);
    case SolveStatus::kInconsistent: return inconsistent(sample);
    case SolveStatus::kNonfiniteInput: return nonfinite_input(sample);
    case SolveStatus::kNonfiniteOperator: return nonfinite_operator(sample);
    case SolveStatus::kStagnated: return stagnated(sample);
    case SolveStatus::kMaxIter: return max_iter_reached(sample);
    default: TORCH_INTERNAL_ASSERT(false, "a solved sample needs no diagnosis");
  }
}

}  // namespace

std::string diagnosis(const FailedSample& sample, SolveStatus status) {
  const at::NoGradGuard no_grad;
  return c10::str(name_of(sample.solver()), " on ", operator_kind(sample.role.a.kind).title, ": ",
                  cause_of(sample, status));
}

}  // namespace prdp
