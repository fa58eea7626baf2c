#pragma once
#include "prdp/solvers/conjugate_gradient.h"
#include "prdp/solvers/direct.h"
#include "prdp/solvers/jacobi.h"
#include "prdp/solvers/solver.h"
#include "prdp/solvers/steepest_descent.h"

namespace prdp {

/// Calls body(method object) for the method that runs in this space.
template <class Space, class Body>
auto with_method(Method method, Space& space, const Body& body) {
  switch (method) {
    case Method::kJacobi: return body(JacobiMethod<Space>(space));
    case Method::kSteepestDescent: return body(SteepestDescentMethod<Space>(space));
    case Method::kConjugateGradient: return body(ConjugateGradientMethod<Space>(space));
    case Method::kGmres: TORCH_CHECK_NOT_IMPLEMENTED(false, "gmres is not there yet");
    case Method::kDirect: break;
  }
  return body(DirectMethod<Space>(space));
}

}  // namespace prdp
