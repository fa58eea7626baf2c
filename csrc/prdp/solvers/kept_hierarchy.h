#pragma once
#include <c10/core/impl/VirtualGuardImpl.h>

#include <mutex>
#include <optional>

#include "prdp/solvers/solver.h"

namespace prdp::gpu {

/// The coarse grids of an A on a GPU, for all solves with it or its transpose on the stream that made them. Another
/// stream makes its own: it might be ahead of them.
class KeptHierarchy {
 public:
  /// Keeps no more bytes than these.
  explicit KeptHierarchy(int64_t most) : most_(most) {}

  /// Undefined where there are none yet.
  at::Tensor get() const {
    const std::lock_guard lock(mutex_);
    return made_.defined() && stream_ == stream_of(made_) ? made_ : at::Tensor();
  }
  void keep(at::Tensor made) {
    if (static_cast<int64_t>(made.nbytes()) > most_) return;
    const std::lock_guard lock(mutex_);
    stream_ = stream_of(made);
    made_ = std::move(made);
  }
  void let_go() {
    const std::lock_guard lock(mutex_);
    made_ = at::Tensor();
  }

 private:
  static c10::Stream stream_of(const at::Tensor& t) {
    return c10::impl::VirtualGuardImpl(t.device().type()).getStream(t.device());
  }

  int64_t most_;
  mutable std::mutex mutex_;
  at::Tensor made_;
  std::optional<c10::Stream> stream_;
};

/// Where so many solves of vectors like b with the same A take coarse grids, what they share takes at most four times
/// the memory of their solutions.
void share_hierarchy(SolveOptions& options, const at::Tensor& b, int64_t solves = 1);
/// The same for solves with one A in all calls. Those of a graph that is captured share none: what it makes is not
/// there before it runs, and what it takes may not be there any more.
void share_hierarchy(SolveOptions& options, const at::Tensor& b, std::shared_ptr<KeptHierarchy> of_all);

}  // namespace prdp::gpu
