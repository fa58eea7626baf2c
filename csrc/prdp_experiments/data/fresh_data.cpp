#include "prdp_experiments/data/fresh_data.h"

#include <utility>

namespace prdp {

namespace {

struct Stopped {};

/// Seeds that are far apart, for epochs that are not.
int64_t seed_of(int64_t seed, int64_t epoch) {
  constexpr uint64_t kGolden = 0x9E3779B97F4A7C15;  // 2⁶⁴ over the golden ratio
  return static_cast<int64_t>(static_cast<uint64_t>(seed) + static_cast<uint64_t>(epoch) * kGolden);
}

}  // namespace

FreshData::FreshData(Scene scene, Dataset first) : scene_(std::move(scene)), first_(std::move(first)) {}

FreshData::~FreshData() {
  stopped_ = true;
  if (made_.valid()) made_.wait();
}

Dataset FreshData::make(int64_t number) const {
  if (number == 0) return first_;
  auto scene = scene_;
  scene.data.seed = seed_of(scene_.data.seed, number);
  return compute_training_samples(scene, [this](int64_t, int64_t) {
    if (stopped_) throw Stopped{};
  });
}

Dataset FreshData::epoch(int64_t number) {
  auto samples = std::exchange(coming_, -1) == number ? made_.get() : make(number);
  coming_ = number + 1;
  made_ = std::async(std::launch::async, [this, next = coming_] { return make(next); });
  return moved(std::move(samples), scene_.device);
}

}  // namespace prdp
