#pragma once
#include <functional>

#include "prdp/autograd/finite_rows.h"
#include "prdp/autograd/solve_vjp.h"

namespace prdp {

/// Residuals up to so many units of rounding are rounding.
inline constexpr double kRoundings = 8.0;

/// Solves again, for a u that is not kept.
using MakeSolution = std::function<at::Tensor()>;

/// The samples that were solved to rounding, but those whose iterations are smooth there: all of a polynomial
/// up to max_iter, and as many of CG as there are unknowns, where none before the last sufficed.
Rows solved_to_rounding(const Operator& a, const Solved& solved, const Solver& solver, const MakeSolution& make_u);

}  // namespace prdp
