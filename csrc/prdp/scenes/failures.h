#pragma once
#include <ATen/ATen.h>

#include <optional>
#include <string>
#include <vector>

namespace prdp {

/// The failed samples of an interval of a training: counted, and the first of them named.
class Failures {
 public:
  /// Takes what the solves of an update say: the status (batch,), or (batch, steps) of a rollout, of every forward solve
  /// and of every adjoint one. `samples`, int64 (batch,): the numbers of the samples among the data; 0, 1, … without.
  /// A sample counts once, and is named with its worst status.
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
