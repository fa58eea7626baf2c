#pragma once
#include <cstdint>
#include <memory>
#include <vector>

#include "prdp/solvers/stopping.h"

/// Iterations that the host does not watch. A look at a number on a GPU waits for all that was queued before it, and
/// costs more than an iteration of a small grid. So the host looks after 1, 2, 4, 8 and then every 16 iterations, at
/// all that they left. In between, the device freezes a sample whose residual comes below rtol or runs away. If
/// anything happened but that, the iterations are taken back and run again, watched one by one: what comes out is the
/// same.
namespace prdp {

/// What unseen iterations left, on the host.
struct UnseenLog {
  std::vector<std::vector<double>> residual2;  // of each iteration and sample
  std::vector<std::vector<bool>> odd;          // where an iteration needs a closer look
  std::vector<int64_t> products;               // of each iteration
};

/// Iterations between two looks, at most.
inline constexpr int64_t kLongestUnseen = 16;

namespace detail {

/// Spaces on another device, and methods whose host takes no part.
template <class Space, class Method>
inline constexpr bool kMayGoUnseen = requires(Space& space) { space.look_back(); } && !kLeastResidual<Method>;

/// What a look after one of these iterations would have said of a sample: whether it goes on or claims to have
/// converged. False where it is neither.
template <class Method>
bool passes(SampleState& s, const Method& method, double residual2, double rtol) {
  s.note(residual2);
  judge(s, rtol);
  if constexpr (kTakesStrides<Method>) plan_next_look(s, method.residual_is_log_convex(), rtol);
  if (rtol > 0.0 && is_idle<Method>(s)) return false;
  s.claims = rtol > 0.0 && s.status == SolveStatus::kConverged;
  return s.active || s.claims;
}

/// Goes through the log of a sample; false where its iterations are to be taken back.
template <class Method>
bool read_log(SampleState& s, size_t sample, const Method& method, const UnseenLog& log, double rtol) {
  for (size_t k = 0; k < log.products.size() && s.active; ++k) {
    if (log.odd[k][sample]) return false;
    ++s.iterations;
    s.applications += log.products[k];
    if (!passes(s, method, log.residual2[k][sample], rtol)) return false;
  }
  return true;
}

/// Takes the true residuals of the samples that claim to have converged; false if one of them has not.
template <class Space, class Method>
bool confirm_claims(Space& space, Method& method, typename Space::States& states, double rtol) {
  const auto claims = [](const SampleState& s) { return s.claims; };
  if (std::none_of(states.begin(), states.end(), claims)) return true;
  space.freeze_unless(states, claims);
  const auto true2 = space.lanes(method.recompute_residual());
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (!s.claims) continue;
    s.residual2 = true2[i];
    if (!std::isfinite(true2[i]) || !is_within(true2[i], rtol, s.b2)) return false;
    s.settled = true;
  }
  return true;
}

/// n iterations, which the space logs; with `track`, their residuals as well.
template <class Space, class Method>
void iterate_unseen(Space& space, Method& method, double rtol, bool track, int64_t n) {
  if constexpr (kHasRecursiveResidual<Method>) space.look_away(track, rtol, method.residual2());
  else space.look_away(track, rtol, {});
  for (int64_t k = 0; k < n; ++k) {
    if constexpr (kTakesStrides<Method>) method.step(1);
    else method.step();
    if (track) space.end_unseen(method.residual2());
    else space.end_unseen();
  }
}

/// n iterations of the active samples, whose residuals are looked at; false if they have been taken back.
template <class Space, class Method>
bool run_unseen(Space& space, Method& method, typename Space::States& states, double rtol, int64_t n) {
  const Method kept = method;  // handles of vectors that nobody writes to
  iterate_unseen(space, method, rtol, /*track=*/true, n);
  const UnseenLog log = space.look_back();
  if constexpr (requires { method.end_unseen(); }) method.end_unseen();
  const auto before = states;
  for (auto& s : states) s.claims = false;
  bool regular = true;
  for (size_t i = 0; i < states.size() && regular; ++i) regular = read_log(states[i], i, method, log, rtol);
  if (regular && confirm_claims(space, method, states, rtol)) return true;
  states = before;
  std::destroy_at(&method);
  std::construct_at(&method, kept);
  return false;
}

}  // namespace detail

}  // namespace prdp
