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

/// A solver and its limits. Each sample starts from zero or from a given start. It stops when ‖b - A u‖ <= rtol ‖b‖, or
/// after max_iter iterations. With rtol = 0, exactly max_iter iterations run.
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
/// Jacobi's iteration, accelerated with the known spectrum of A; for Heat and Poisson only (Golub and Varga 1961).
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

/// The report of a solve: tensors of shape (batch,), with one value per sample.
struct SolveInfo {
  at::Tensor iterations;             // iterations that produced the returned u
  at::Tensor residual;               // ‖b - A u‖ / ‖b‖, recomputed from u
  at::Tensor status;                 // SolveStatus
  at::Tensor operator_applications;  // number of products with A
};

/// A value of checkpoint_every that stands for ⌈√K⌉, where K is the number of iterations that ran.
inline constexpr int64_t kCheckpointSqrt = -1;

/// All settings of a differentiable solve.
struct SolveOptions {
  Solver solver;
  Backward backward = Backward::kImplicit;
  std::optional<c10::SymInt> adjoint_max_iter{};  // by default those of the solver
  std::optional<double> adjoint_rtol{};
  OnFailure on_failure = OnFailure::kRaise;
  int64_t adjoint_log = 0;  // the log that gets the report of the adjoint solve (adjoint_log.h); 0: none
  /// With n > 0, unrolled mode stores every n-th iterate and recomputes the others; 0 stores all.
  int64_t checkpoint_every = 0;
  Start start = Start::kZero;  // only for steps and rollouts; linear_solve() has the argument x0

  /// Raises ValueError, in the name of `who`, for a setting out of range.
  void check(const char* who) const;
};

}  // namespace prdp
