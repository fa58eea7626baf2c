#pragma once
#include "prdp/solvers/conjugate_gradient.h"
#include "prdp/solvers/direct.h"
#include "prdp/solvers/gmres.h"
#include "prdp/solvers/jacobi.h"
#include "prdp/solvers/solver.h"
#include "prdp/solvers/steepest_descent.h"

namespace prdp {

/// Vectors that a method keeps at most, beside b and one of scratch.
inline int64_t vectors_of(Method method, int64_t restart) {
  return method == Method::kGmres ? restart + 5 : 4;
}

/// Calls body(method object) for the method that runs in this space.
template <class Space, class Body>
auto with_method(Method method, int64_t restart, Space& space, const Body& body) {
  switch (method) {
    case Method::kJacobi: return body(JacobiMethod<Space>(space));
    case Method::kChebyshev: return body(JacobiMethod<Space>(space, /*accelerated=*/true));
    case Method::kSteepestDescent: return body(SteepestDescentMethod<Space>(space));
    case Method::kConjugateGradient: return body(ConjugateGradientMethod<Space>(space));
    case Method::kGmres: return body(GmresMethod<Space>(space, restart, false));
    case Method::kGmresStokes: return body(GmresMethod<Space>(space, restart, true));
    case Method::kDirect: break;
  }
  return body(DirectMethod<Space>(space));
}

}  // namespace prdp
