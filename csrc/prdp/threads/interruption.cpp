#include "prdp/threads/interruption.h"

#include <c10/util/Exception.h>

namespace prdp::interruption {

namespace {

std::atomic<Check> the_check = nullptr;

constexpr std::chrono::milliseconds kBetweenChecks{100};

}  // namespace

void set_check(Check check) { the_check = check; }

Watch& Watch::local() {
  static thread_local Watch watch;
  return watch;
}

void Watch::look() {
  left_ = kBudget;
  if (stop_ && stop_->load(std::memory_order_relaxed)) throw Stopped{};
  const Check check = the_check.load(std::memory_order_relaxed);
  if (!check || checking_) return;
  const auto now = std::chrono::steady_clock::now();
  if (now < next_check_) return;
  next_check_ = now + kBetweenChecks;
  struct Checking {
    bool& flag;
    ~Checking() { flag = false; }
  } const now_checking{checking_ = true};
  check();
}

Watch::Member::Member(const std::atomic<bool>& stop) : watch_(Watch::local()), before_(watch_.stop_) {
  // It would use the memory of the solve that it has come in the middle of.
  TORCH_CHECK(!watch_.checking_, "a signal handler that runs during a solve cannot solve on the same thread");
  watch_.stop_ = &stop;
}

}  // namespace prdp::interruption
