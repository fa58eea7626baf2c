#pragma once
#include <optional>

#include "prdp/solvers/solve.h"

namespace prdp {

/// A solve of exactly max_iter iterations on another device, for which the host queues operations and waits at most
/// once, at the end. What comes out is what a watched solve gives, to the last bit. Nothing if the solve is to be
/// watched: with a tolerance, with methods whose host takes part, and if a sample broke down, ran away or ended worse
/// than zero.
///
/// Unless request.may_wait, the host never waits. The report then lies on the device. Samples that ran away or ended
/// worse than zero are zero, with 0 iterations. A method that may start anew waits all the same.
std::optional<SolveResult> solve_unseen(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// Whether the host never waits for such a solve if it need not.
bool never_waits(const at::Tensor& b, const Solver& solver);

}  // namespace prdp
