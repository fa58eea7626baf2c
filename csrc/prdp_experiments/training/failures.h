#pragma once
#include <ATen/ATen.h>

#include <optional>
#include <string>
#include <vector>

namespace prdp {

/// The failed samples of an interval: their number, and a list of the first ones.
class Failures {
 public:
  /// Adds the solves of an update: the statuses of each forward and of each adjoint solve, (batch,), or (batch, steps)
  /// for a rollout. `samples`, int64 (batch,), are the numbers of the samples in the data set; by default 0, 1, …. A
  /// sample counts once, and is listed with its worst status.
  void take(const std::vector<at::Tensor>& forward, const std::vector<at::Tensor>& adjoint,
            const std::optional<at::Tensor>& samples = {});

  int64_t count() const { return count_; }
  /// "interval 12: 3 failed samples: sample 4 DIVERGED in the forward solve, sample 7 BREAKDOWN in the adjoint solve";
  /// empty where there was none.
  std::string line(int64_t interval) const;

 private:
  int64_t count_ = 0;
  std::vector<std::string> named_;
};

}  // namespace prdp
