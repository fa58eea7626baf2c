#pragma once
#include <ATen/ATen.h>

#include <array>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

#include "prdp/operators/operator.h"
#include "prdp/solvers/status.h"

namespace prdp {

namespace gpu {
class KeptHierarchy;
}

/// methods.h describes each.
enum class Method {
  kJacobi,
  kChebyshev,
  kSteepestDescent,
  kConjugateGradient,
  kBiCGStab,
  kGmres,
  kMinres,
  kMultigrid,
  kDirect
};

/// Smoothing steps of multigrid before and after each coarse grid.
inline constexpr int64_t kDefaultSmoothing = 2;

/// M ≈ A, whose inverse CG, BiCGStab, GMRES and MINRES may apply in every iteration; the adjoint solve applies the
/// transpose. In unrolled derivatives M is a constant, unless it is the diagonal.
class Preconditioner {
 public:
  Preconditioner() = default;  // none
  /// Any operator whose product is M⁻¹ r. CG needs a symmetric definite one.
  Preconditioner(OperatorSpec inverse) : spec_(std::move(inverse)) {}
  /// The diagonal of A.
  static Preconditioner diagonal() { return OperatorSpec{"diagonal", {}, {}, {}}; }

  explicit operator bool() const { return !spec_.kind.empty(); }
  bool is_diagonal() const { return spec_.kind == "diagonal"; }
  bool is_multigrid() const { return spec_.kind == "multigrid"; }
  /// Whether it is an operator of the user's own.
  bool is_operator() const { return *this && !is_diagonal() && !is_multigrid(); }
  int64_t smoothing() const { return spec_.shape.empty() ? kDefaultSmoothing : spec_.shape[0]; }
  /// A V-cycle of multigrid, with so many smoothing steps before and after each coarse grid; for Heat, Poisson,
  /// Diffusion, Burgers, stencils whose neighbours lie at most one cell away and NavierStokes, which takes cycles as a
  /// preconditioner only.
  static Preconditioner multigrid(int64_t smoothing = kDefaultSmoothing) {
    return OperatorSpec{"multigrid", {smoothing}, {}, {}};
  }
  /// As it crosses torch's dispatcher: the operator, or the name in its `kind`; empty for none.
  const OperatorSpec& spec() const { return spec_; }
  Preconditioner transposed() const;
  /// "diagonal", "Function"; empty for none.
  std::string title() const;

 private:
  OperatorSpec spec_;
};

/// Relative residual at which an iteration may stop, ε in the paper.
inline constexpr double kDefaultRtol = 1e-5;
/// Products in a cycle of GMRES.
inline constexpr int64_t kDefaultRestart = 10;

/// A max_iter that nobody set, which every solve refuses.
inline constexpr int64_t kToBeGiven = -1;

/// A solver and its limits. Each sample starts from zero or from a given start. It stops when ‖b - A u‖ <= rtol ‖b‖, or
/// after max_iter iterations. With rtol = 0, exactly max_iter iterations run.
struct Solver {
  Method method{};
  c10::SymInt max_iter = kToBeGiven;  // K; symbolic only while a graph is being traced
  double rtol = kDefaultRtol;
  int64_t restart = kDefaultRestart;  // m of GMRES(m)
  Preconditioner preconditioner{};

  /// Raises ValueError unless max_iter >= 0, 0 <= rtol < 1 and restart >= 1, and for a preconditioner that the method
  /// does not take.
  void check(const char* who) const;
};

/// A method with a limit and a tolerance.
template <Method kMethod>
struct PlainMethod {
  int64_t max_iter = kToBeGiven;
  double rtol = kDefaultRtol;
  operator Solver() const { return {kMethod, max_iter, rtol}; }
};
/// One that takes a preconditioner, too.
template <Method kMethod>
struct PreconditionedMethod {
  int64_t max_iter = kToBeGiven;
  double rtol = kDefaultRtol;
  Preconditioner preconditioner{};
  operator Solver() const { return {kMethod, max_iter, rtol, kDefaultRestart, preconditioner}; }
};

using Jacobi = PlainMethod<Method::kJacobi>;
/// Jacobi's iteration, accelerated with the known spectrum of A; for Heat and Poisson only (Golub and Varga 1961).
using Chebyshev = PlainMethod<Method::kChebyshev>;
using SteepestDescent = PlainMethod<Method::kSteepestDescent>;
/// For symmetric definite operators.
using CG = PreconditionedMethod<Method::kConjugateGradient>;
/// For any operator; two products with A per iteration. Preconditioned from the right.
using BiCGStab = PreconditionedMethod<Method::kBiCGStab>;
/// For symmetric operators, definite or not. A preconditioner must be positive definite.
using MINRES = PreconditionedMethod<Method::kMinres>;
/// Restarted; max_iter counts cycles. Preconditioned from the right.
struct GMRES {
  int64_t restart = kDefaultRestart;
  int64_t max_iter = kToBeGiven;
  double rtol = kDefaultRtol;
  Preconditioner preconditioner{};
  operator Solver() const { return {Method::kGmres, max_iter, rtol, restart, preconditioner}; }
};
/// V-cycles, u ← u + M⁻¹(b - A u); max_iter counts them. For the operators that Preconditioner::multigrid() is for.
struct Multigrid {
  int64_t max_iter = kToBeGiven;
  double rtol = kDefaultRtol;
  int64_t smoothing = kDefaultSmoothing;
  operator Solver() const {
    return {Method::kMultigrid, max_iter, rtol, kDefaultRestart, Preconditioner::multigrid(smoothing)};
  }
};
/// The cheapest exact method of the operator. An iteration is one direct solve; those after the first refine its
/// result.
struct Direct {
  int64_t max_iter = 1;
  double rtol = kDefaultRtol;
  operator Solver() const { return {Method::kDirect, max_iter, rtol}; }
};

/// How gradients are computed.
enum class Backward {
  kImplicit,  // by one adjoint solve Aᵀ λ = ū with the same method; only u is stored
  kUnrolled,  // as the exact derivative of the iterations that ran
  kNone,      // u carries no gradient
};

/// Where the solves of a step start: at zero, or at the state before the step, which linear_solve()
/// takes as x0.
enum class Start { kZero, kState };

/// What happens if a sample fails: an error, a warning, or only its status. kZeroGrad is kReturn without a gradient: b
/// and A get none from the sample, whether its forward or its adjoint solve failed.
enum class OnFailure { kRaise, kWarn, kReturn, kZeroGrad };

/// Which numbers of A the host looks at before a solve: those of a sample alone are left to fail alone, unless any
/// failure raises.
inline Checks checks_of(OnFailure on_failure) {
  return on_failure == OnFailure::kRaise ? Checks::kAll : Checks::kShared;
}

/// Names as users write them; from_name raises ValueError naming the allowed ones.
std::string_view name(Method method);
std::string_view name(Backward backward);
std::string_view name(OnFailure on_failure);
std::string_view name(Start start);
Method method_from_name(std::string_view name);
Backward backward_from_name(std::string_view name);
OnFailure on_failure_from_name(std::string_view name);
Start start_from_name(std::string_view name);

/// The same of a tensor of statuses.
inline at::Tensor is_failure(const at::Tensor& status) {
  return status.lt(static_cast<int64_t>(SolveStatus::kStagnated));
}
inline at::Tensor is_refused(const at::Tensor& status) {
  return status.eq(static_cast<int64_t>(SolveStatus::kZeroDiagonal))
      .logical_or(status.le(static_cast<int64_t>(SolveStatus::kNonfiniteInput)));
}

/// The report of a solve: tensors of shape (batch,), with one value per sample.
struct SolveInfo {
  at::Tensor iterations;             // iterations that produced the returned u
  at::Tensor residual;               // ‖b - A u‖ / ‖b‖, recomputed from u
  at::Tensor status;                 // SolveStatus
  at::Tensor operator_applications;  // number of products with A
  /// Where the dtype cannot reach rtol, the relative residual that its rounding leaves, ε ‖A‖ ‖u‖ / ‖b‖: the sample is
  /// STAGNATED, and u as accurate as the dtype allows. 0 for all other samples, failed ones among them.
  at::Tensor floor;

  /// All of them, in this order.
  std::array<at::Tensor*, 5> parts() { return {&iterations, &residual, &status, &operator_applications, &floor}; }
  /// Which samples are solved, as far as their dtype goes (bool).
  at::Tensor solved() const { return status.gt(0).logical_or(floor.gt(0)); }
};

/// The floors of a report with this status: no rounding excuses a failure.
inline at::Tensor floor_of(const at::Tensor& floor, const at::Tensor& status) {
  return floor.masked_fill(status.lt(static_cast<int64_t>(SolveStatus::kStagnated)), 0.0);
}

/// A value of checkpoint_every that stands for ⌈√K⌉, where K is the number of iterations that ran.
inline constexpr int64_t kCheckpointSqrt = -1;

/// All settings of a differentiable solve.
struct SolveOptions {
  Solver solver;
  Backward backward = Backward::kImplicit;
  std::optional<c10::SymInt> adjoint_max_iter{};  // by default those of the solver
  std::optional<double> adjoint_rtol{};
  OnFailure on_failure = OnFailure::kRaise;
  c10::SymInt adjoint_log = 0;  // the log that gets the report of the adjoint solve (adjoint_log.h); 0: none
  /// With n > 0, unrolled mode stores every n-th iterate and recomputes the others; 0 stores all.
  int64_t checkpoint_every = 0;
  Start start = Start::kZero;  // only for steps and rollouts; linear_solve() has the argument x0
  /// Whether each part of a report has memory of its own on a GPU, too, as the results of an op of torch must.
  bool report_apart = false;
  /// On a GPU, the coarse grids of A, which solves with it and with its transpose share; null: nothing is kept.
  std::shared_ptr<gpu::KeptHierarchy> hierarchy{};
  /// The caller has taken off cotangents what A cannot reach: what rounding has left of it is small beside the rest.
  bool cotangent_is_in_range = false;
  /// The channels of b are the components of one vector: a small one need not be solved by itself.
  bool channels_are_components = false;
  /// Only while a graph is being traced: the tolerances, if they are symbolic, each as the integer of its bits.
  c10::SymInt traced_rtol{-1}, traced_adjoint_rtol{-1};

  /// Raises ValueError, in the name of `who`, for a setting out of range.
  void check(const char* who) const;
};

/// Whether the host needs the report of a solve at once: to raise or to warn, or to take its iterations back.
inline bool waits_for_report(const SolveOptions& options) {
  const bool says_nothing = options.on_failure == OnFailure::kReturn || options.on_failure == OnFailure::kZeroGrad;
  return !says_nothing || options.backward == Backward::kUnrolled;
}

}  // namespace prdp
