#pragma once
#include <ATen/ATen.h>

#include <optional>
#include <string>
#include <string_view>

namespace prdp {

/// What each of them is, methods.h says.
enum class Method {
  kJacobi,
  kChebyshev,
  kSteepestDescent,
  kConjugateGradient,
  kConjugateGradientDiagonal,
  kBiCGStab,
  kGmres,
  kGmresDiagonal,
  kGmresStokes,
  kDirect
};

/// What CG and GMRES may be preconditioned by: the diagonal of A, or a Navier-Stokes step without winds.
enum class Preconditioner { kNone, kDiagonal, kStokes };

/// Relative residual at which an iteration may stop, ε in the paper.
inline constexpr double kDefaultRtol = 1e-5;
/// Products in a cycle of GMRES.
inline constexpr int64_t kDefaultRestart = 10;

/// A solver and its budget. All start from zero, unless they are given a start, and stop at the first of
/// ‖b - A u‖ <= rtol ‖b‖ or max_iter iterations; rtol = 0 runs exactly max_iter.
struct Solver {
  Method method;
  c10::SymInt max_iter;  // K; symbolic only while a graph is being traced
  double rtol = kDefaultRtol;
  int64_t restart = kDefaultRestart;  // m of GMRES(m)

  /// Raises ValueError unless max_iter >= 0, rtol >= 0 and restart >= 1.
  void check(const char* who) const;
};

struct Jacobi {
  int64_t max_iter;
  double rtol = kDefaultRtol;
  operator Solver() const { return {Method::kJacobi, max_iter, rtol}; }
};
/// Jacobi's iteration accelerated by what is known of the spectrum; for Heat and Poisson.
struct Chebyshev {
  int64_t max_iter;
  double rtol = kDefaultRtol;
  operator Solver() const { return {Method::kChebyshev, max_iter, rtol}; }
};
struct SteepestDescent {
  int64_t max_iter;
  double rtol = kDefaultRtol;
  operator Solver() const { return {Method::kSteepestDescent, max_iter, rtol}; }
};
/// For symmetric definite operators. Preconditioner: kNone or kDiagonal; another one raises ValueError.
struct CG {
  int64_t max_iter;
  double rtol = kDefaultRtol;
  Preconditioner preconditioner = Preconditioner::kNone;
  operator Solver() const;
};
/// For any operator; two products with A per iteration.
struct BiCGStab {
  int64_t max_iter;
  double rtol = kDefaultRtol;
  operator Solver() const { return {Method::kBiCGStab, max_iter, rtol}; }
};
/// Restarted; max_iter counts cycles. Preconditioned from the right; kStokes is for NavierStokes alone
/// and runs in plain tensor operations.
struct GMRES {
  int64_t restart = kDefaultRestart;
  int64_t max_iter;
  double rtol = kDefaultRtol;
  Preconditioner preconditioner = Preconditioner::kNone;
  operator Solver() const;
};
/// The cheapest exact method of the operator; an iteration is one direct solve, those after the
/// first refine its result.
struct Direct {
  int64_t max_iter = 1;
  double rtol = kDefaultRtol;
  operator Solver() const { return {Method::kDirect, max_iter, rtol}; }
};

/// How the derivative of a solve is taken.
enum class Backward {
  kImplicit,  // one adjoint solve Aᵀ λ = ū with the same method; keeps u only
  kUnrolled,  // the exact derivative of the iterations that ran
  kNone,      // u carries no gradient
};

/// Where the solves of a step start: from zero, or from the state before the step as linear_solve() scales
/// a start.
enum class Start { kZero, kState };

/// What a failed sample does: raise an error, warn, or only say so in its status. kZeroGrad is kReturn without a
/// derivative: nothing that the sample is made of gets a gradient from it, whether its solve failed or the adjoint one.
enum class OnFailure { kRaise, kWarn, kReturn, kZeroGrad };

/// Names as users write them; from_name raises ValueError naming the allowed ones.
std::string_view name(Method method);
std::string_view name(Preconditioner preconditioner);
std::string_view name(Backward backward);
std::string_view name(OnFailure on_failure);
std::string_view name(Start start);
Method method_from_name(std::string_view name);
Backward backward_from_name(std::string_view name);
OnFailure on_failure_from_name(std::string_view name);
Start start_from_name(std::string_view name);

/// What a solve says of itself, one value per sample, each tensor of shape (batch,).
struct SolveInfo {
  at::Tensor iterations;             // that made the returned u
  at::Tensor residual;               // ‖b - A u‖ / ‖b‖, recomputed from u
  at::Tensor status;                 // SolveStatus
  at::Tensor operator_applications;  // products with A, all told
};

/// For checkpoint_every: ⌈√K⌉, K being the iterations that ran.
inline constexpr int64_t kCheckpointSqrt = -1;

/// Everything about a solve but the operator and b.
struct SolveOptions {
  Solver solver;
  Backward backward = Backward::kImplicit;
  std::optional<c10::SymInt> adjoint_max_iter{};  // the primal's where not given
  std::optional<double> adjoint_rtol{};
  OnFailure on_failure = OnFailure::kRaise;
  int64_t adjoint_log = 0;  // where the adjoint solve leaves its SolveInfo (adjoint_log.h); 0: nowhere
  /// Unrolled mode keeps every so many iterates and runs those between again; 0: keeps all.
  int64_t checkpoint_every = 0;
  Start start = Start::kZero;  // of steps and rollouts; linear_solve() itself takes x0

  /// Raises ValueError for a budget, tolerance or interval out of range, naming it.
  void check(const char* who) const;
};

}  // namespace prdp
