#pragma once
#include <mutex>

#include "prdp/solvers/solver.h"

namespace prdp::gpu {

/// The coarse grids of an A on a GPU, for all solves with it or its transpose.
class KeptHierarchy {
 public:
  /// Keeps no more bytes than these.
  explicit KeptHierarchy(int64_t most) : most_(most) {}

  /// Undefined where there are none yet.
  at::Tensor get() const {
    const std::lock_guard lock(mutex_);
    return made_;
  }
  void keep(at::Tensor made) {
    if (static_cast<int64_t>(made.nbytes()) > most_) return;
    const std::lock_guard lock(mutex_);
    made_ = std::move(made);
  }
  void let_go() {
    const std::lock_guard lock(mutex_);
    made_ = at::Tensor();
  }

 private:
  int64_t most_;
  mutable std::mutex mutex_;
  at::Tensor made_;
};

/// Where so many solves of vectors like b with the same A take coarse grids, what they share takes at most four times
/// the memory of their solutions.
void share_hierarchy(SolveOptions& options, const at::Tensor& b, int64_t solves = 1);

}  // namespace prdp::gpu
