#pragma once
#include "prdp/solvers/conjugate_gradient.h"
#include "prdp/solvers/direct.h"
#include "prdp/solvers/gmres.h"
#include "prdp/solvers/jacobi.h"
#include "prdp/solvers/preconditioned_conjugate_gradient.h"
#include "prdp/solvers/solver.h"
#include "prdp/solvers/steepest_descent.h"

namespace prdp {

/// Vectors that a method keeps at most, beside b and one of scratch.
inline int64_t vectors_of(Method method, int64_t restart) {
  return is_gmres(method) ? restart + 5 : method == Method::kConjugateGradientDiagonal ? 5 : 4;
}

/// Calls body(method object) for the method that runs in this space.
template <class Space, class Body>
auto with_method(Method method, int64_t restart, Space& space, const Body& body) {
  switch (method) {
    case Method::kJacobi: return body(JacobiMethod<Space>(space));
    case Method::kChebyshev: return body(JacobiMethod<Space>(space, /*accelerated=*/true));
    case Method::kSteepestDescent: return body(SteepestDescentMethod<Space>(space));
    case Method::kConjugateGradient: return body(ConjugateGradientMethod<Space>(space));
    case Method::kConjugateGradientDiagonal: return body(PreconditionedConjugateGradientMethod<Space>(space));
    case Method::kGmres: return body(GmresMethod<Space>(space, restart, Preconditioner::kNone));
    case Method::kGmresDiagonal: return body(GmresMethod<Space>(space, restart, Preconditioner::kDiagonal));
    case Method::kGmresStokes: return body(GmresMethod<Space>(space, restart, Preconditioner::kStokes));
    case Method::kDirect: break;
  }
  return body(DirectMethod<Space>(space));
}

}  // namespace prdp
