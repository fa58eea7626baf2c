#pragma once
#include <array>
#include <string_view>
#include <tuple>
#include <type_traits>

#include "prdp/solvers/bicgstab.h"
#include "prdp/solvers/conjugate_gradient.h"
#include "prdp/solvers/defect_correction.h"
#include "prdp/solvers/gmres.h"
#include "prdp/solvers/jacobi.h"
#include "prdp/solvers/minres.h"
#include "prdp/solvers/solver.h"
#include "prdp/solvers/steepest_descent.h"

/// The table of methods. Whatever the library wants to know about a method, it reads here; what a class says of itself
/// to the loop is in method_properties.h. CONTRIBUTING.md says how to add a method.
namespace prdp {

/// What max_iter counts: iterations, or cycles, each of which builds up as many vectors as `restart` says.
enum class Counts { kIterations, kCycles };

/// The operators that a method is made for. On others it may fail, and the error names the reason.
enum class MadeFor {
  kAny,
  kDefinite,       // symmetric and definite
  kSymmetric,
  kDominant,       // the spectral radius of I - D⁻¹A is below 1
  kKnownSpectrum   // the operator knows that radius: Heat and Poisson
};

/// One row of the table.
struct MethodTraits {
  Method method;
  std::string_view name;   // in scenes and in the ops
  std::string_view label;  // its class in C++ and Python, which errors name
  MadeFor made_for = MadeFor::kAny;
  Counts counts = Counts::kIterations;
  int64_t products = 1;       // with A per iteration, or per vector of a cycle
  int64_t vectors;            // that it keeps at most beside b and scratch; a cycle keeps `restart` more
  bool takes_preconditioner = false;  // and then keeps at most two vectors more
  double nanoseconds;         // of a core per unknown and iteration, or vector of a cycle
  bool divides_by_diagonal = false;  // refuses an operator with a zero on it
  bool is_direct = false;  // takes the operator's exact method, and no start
  /// From zero, u = p(M⁻¹A) M⁻¹ b, M being the diagonal or a cycle, and p a polynomial that the number of iterations
  /// fixes. Then u is smooth in A and linear in b, and the transposed map is as many iterations with Aᵀ and M⁻ᵀ.
  bool is_polynomial = false;
  bool ends_at_unknowns = false;  // exact after as many iterations as unknowns, and smooth up to there
  bool nears_breakdowns = false;  // even of a well-conditioned A, and amplifies rounding there
  /// Whether unrolled iterations in the CPU loops are differentiated there, operation by operation (autograd/tape.h);
  /// else autograd does it, in plain tensor operations.
  bool has_tape = true;
  /// Its class and file, from which kernels of a GPU are made; empty: there is none.
  std::string_view kernel{}, kernel_header{};
  ArraySizes (*arrays)(int64_t restart) = no_arrays;  // of its members
};

/// A row with the class that iterates.
template <template <IterationSpace> class Iteration>
struct MethodRow : MethodTraits {
  template <IterationSpace Space>
  auto make(Space& space, int64_t restart) const {
    if constexpr (std::is_constructible_v<Iteration<Space>, Space&, int64_t>) return Iteration<Space>(space, restart);
    else return Iteration<Space>(space);
  }
};

/// In the order of the enumerators.
inline constexpr std::tuple kMethods{
    MethodRow<JacobiMethod>{{
        .method = Method::kJacobi,
        .name = "jacobi",
        .label = "Jacobi",
        .made_for = MadeFor::kDominant,
        .vectors = 4,
        .nanoseconds = 0.1,
        .divides_by_diagonal = true,
        .is_polynomial = true,
        .kernel = "JacobiMethod",
        .kernel_header = "jacobi.h",
    }},
    MethodRow<ChebyshevMethod>{{
        .method = Method::kChebyshev,
        .name = "chebyshev",
        .label = "Chebyshev",
        .made_for = MadeFor::kKnownSpectrum,
        .vectors = 4,
        .nanoseconds = 0.1,
        .is_polynomial = true,
        .has_tape = false,
        .kernel = "ChebyshevMethod",
        .kernel_header = "jacobi.h",
        .arrays = arrays_of_chebyshev,
    }},
    MethodRow<SteepestDescentMethod>{{
        .method = Method::kSteepestDescent,
        .name = "steepest_descent",
        .label = "SteepestDescent",
        .made_for = MadeFor::kDefinite,
        .vectors = 4,
        .nanoseconds = 0.3,
        .kernel = "SteepestDescentMethod",
        .kernel_header = "steepest_descent.h",
    }},
    MethodRow<ConjugateGradientMethod>{{
        .method = Method::kConjugateGradient,
        .name = "cg",
        .label = "CG",
        .made_for = MadeFor::kDefinite,
        .vectors = 4,
        .takes_preconditioner = true,
        .nanoseconds = 0.3,
        .ends_at_unknowns = true,
        .kernel = "ConjugateGradientMethod",
        .kernel_header = "conjugate_gradient.h",
    }},
    MethodRow<BiCGStabMethod>{{
        .method = Method::kBiCGStab,
        .name = "bicgstab",
        .label = "BiCGStab",
        .products = 2,
        .vectors = 6,
        .takes_preconditioner = true,
        .nanoseconds = 0.8,
        .nears_breakdowns = true,
        .kernel = "BiCGStabMethod",
        .kernel_header = "bicgstab.h",
    }},
    MethodRow<GmresMethod>{{
        .method = Method::kGmres,
        .name = "gmres",
        .label = "GMRES",
        .counts = Counts::kCycles,
        .vectors = 4,
        .takes_preconditioner = true,
        .nanoseconds = 0.8,
        .kernel = "GmresMethod",
        .kernel_header = "gmres.h",
        .arrays = arrays_of_gmres,
    }},
    MethodRow<MinresMethod>{{
        .method = Method::kMinres,
        .name = "minres",
        .label = "MINRES",
        .made_for = MadeFor::kSymmetric,
        .vectors = 8,
        .takes_preconditioner = true,
        .nanoseconds = 0.6,
        .ends_at_unknowns = true,
        .has_tape = false,
        .kernel = "MinresMethod",
        .kernel_header = "minres.h",
        .arrays = arrays_of_minres,
    }},
    MethodRow<MultigridMethod>{{
        .method = Method::kMultigrid,
        .name = "multigrid",
        .label = "Multigrid",
        .vectors = 3,
        .nanoseconds = 4.0,
        .is_polynomial = true,
        .kernel = "MultigridMethod",
        .kernel_header = "defect_correction.h",
    }},
    MethodRow<DirectMethod>{{
        .method = Method::kDirect,
        .name = "direct",
        .label = "Direct",
        .vectors = 4,
        .nanoseconds = 0.3,
        .is_direct = true,
        .has_tape = false,
    }},
};

inline constexpr auto kTraits =
    std::apply([](const auto&... row) { return std::array<MethodTraits, sizeof...(row)>{row...}; }, kMethods);
static_assert(
    [] {
      for (size_t i = 0; i < kTraits.size(); ++i)
        if (static_cast<size_t>(kTraits[i].method) != i) return false;
      return true;
    }(),
    "the rows of the table are not in the order of the enumerators");

constexpr const MethodTraits& traits(Method method) { return kTraits[static_cast<size_t>(method)]; }

/// A row as a type, for what is decided at compile time.
template <size_t i>
struct MethodAt {
  static constexpr const auto& row = std::get<i>(kMethods);
};

/// Calls body(MethodAt<…>()) for this method; `i` is where the search begins.
template <size_t i = 0, class Body>
auto with_row(Method method, const Body& body) {
  if constexpr (i + 1 < kTraits.size())
    if (static_cast<size_t>(method) != i) return with_row<i + 1>(method, body);
  return body(MethodAt<i>());
}

/// Calls body(method object) for the method that runs in this space.
template <IterationSpace Space, class Body>
auto with_method(Method method, int64_t restart, Space& space, const Body& body) {
  return with_row(method, [&](auto at) { return body(at.row.make(space, restart)); });
}

/// Vectors that a method keeps at most, beside b and one of scratch.
constexpr int64_t vectors_of(Method method, int64_t restart) {
  const auto& row = traits(method);
  return row.vectors + (row.takes_preconditioner ? 2 : 0) + (row.counts == Counts::kCycles ? restart : 0);
}

/// Whether the solver refuses an operator with a zero on its diagonal.
inline bool divides_by_diagonal(const Solver& solver) {
  return traits(solver.method).divides_by_diagonal || solver.preconditioner.is_diagonal();
}

/// Iterations, or those vectors that so many cycles build up.
constexpr double steps_of(Method method, int64_t iterations, int64_t restart) {
  return static_cast<double>(iterations) * static_cast<double>(traits(method).counts == Counts::kCycles ? restart : 1);
}

}  // namespace prdp
