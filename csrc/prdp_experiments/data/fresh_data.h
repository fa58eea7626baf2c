#pragma once
#include <atomic>
#include <future>

#include "prdp_experiments/data/data.h"

namespace prdp {

/// The training samples of each epoch of a scene with `data.fresh`: no sample is seen twice. Those of the next epoch
/// are made in another thread while one trains. They depend on the scene and the number of the epoch alone, so a
/// training that goes on from a checkpoint sees the same.
class FreshData {
 public:
  /// `first`: the samples of the first epoch, which `make_dataset` has made.
  FreshData(Scene scene, Dataset first);
  /// Stops what is being made.
  ~FreshData();
  FreshData(const FreshData&) = delete;
  FreshData& operator=(const FreshData&) = delete;

  /// The samples of epoch `number`, counted from 0, in the train_ fields of a Dataset. Raises RuntimeError where a
  /// reference solve does not converge.
  Dataset epoch(int64_t number);

 private:
  Dataset make(int64_t number) const;

  Scene scene_;
  Dataset first_;
  std::atomic<bool> stopped_ = false;
  int64_t coming_ = -1;  // the epoch that is being made
  std::future<Dataset> made_;
};

}  // namespace prdp
