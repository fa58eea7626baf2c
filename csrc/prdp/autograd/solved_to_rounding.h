#pragma once
#include <functional>

#include "prdp/autograd/finite_rows.h"
#include "prdp/autograd/solve_vjp.h"

namespace prdp {

/// Residuals up to so many units of rounding are rounding.
inline constexpr double kRoundings = 8.0;

/// Solves again, for a u that is not kept.
using MakeSolution = std::function<at::Tensor()>;

/// The samples solved to rounding. Left out are those whose iterations still have a smooth derivative there: polynomial
/// methods that ran all max_iter iterations, and CG or MINRES that needed as many iterations as there are unknowns.
Rows solved_to_rounding(const Operator& a, const Solved& solved, const Solver& solver, const MakeSolution& make_u);

}  // namespace prdp
