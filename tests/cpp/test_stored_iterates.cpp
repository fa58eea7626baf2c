#include <gtest/gtest.h>

#include <map>
#include <vector>

#include "prdp/autograd/stored_iterates.h"

namespace {

/// Iterations that count themselves: the state is their number.
struct Counting {
  int64_t now = 0, runs = 0;
  std::map<int64_t, int64_t> kept;
  std::vector<int64_t> taken_back;

  void start() { now = 0; }
  void step() { ++now, ++runs; }
  void save(int64_t slot) { kept[slot] = now; }
  void load(int64_t slot, int64_t k) {
    now = kept.at(slot);
    EXPECT_EQ(now, k);
  }
  void step_back(int64_t slot, int64_t k) {
    EXPECT_EQ(kept.at(slot), k);  // what the iteration starts from
    EXPECT_EQ(now, k);            // has just been loaded
    step();
    taken_back.push_back(k);
  }
};

TEST(RunBack, TakesEveryIterationBackOnceAndKeepsWhatItWasAsked) {
  for (const int64_t k : {1, 2, 7, 16, 40})
    for (const int64_t every : {int64_t{0}, int64_t{1}, int64_t{3}, int64_t{100}, prdp::kCheckpointSqrt}) {
      const prdp::StoredIterates plan(k, every);
      Counting run;
      run_back(run, plan);
      ASSERT_EQ(static_cast<int64_t>(run.taken_back.size()), k);
      for (int64_t i = 0; i < k; ++i) EXPECT_EQ(run.taken_back[i], k - 1 - i);
      EXPECT_LE(static_cast<int64_t>(run.kept.size()), plan.slots());
      EXPECT_LT(run.kept.rbegin()->first, plan.slots());
      EXPECT_LE(run.runs, 3 * k);
    }
}

TEST(RunBack, SquareRootKeepsFewest) {
  EXPECT_EQ(prdp::StoredIterates(160, prdp::kCheckpointSqrt).slots(), 13 + 13);
  EXPECT_EQ(prdp::StoredIterates(160, 0).slots(), 160 + 1);
  EXPECT_EQ(prdp::StoredIterates(160, 40).slots(), 40 + 4);
  EXPECT_EQ(prdp::StoredIterates(5, 100).slots(), 5 + 1);
}

}  // namespace
