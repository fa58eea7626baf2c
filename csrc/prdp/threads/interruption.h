#pragma once
#include <ATen/Parallel.h>

#include <atomic>
#include <chrono>
#ifdef __SANITIZE_THREAD__
#include <algorithm>
#include <exception>
#include <thread>
#include <vector>
#endif

/// Ends a long computation from outside, for Python's Ctrl-C. The loops count their work, and from time to time run a
/// check that may throw on the calling thread. The partial result is lost.
namespace prdp::interruption {

/// Called about ten times per second on every thread that computes; throws to end the computation. There is
/// none until somebody sets it.
using Check = void (*)();
void set_check(Check check);

/// Thrown on helper threads if another thread has given up its part of the work.
struct Stopped {};

/// Counts the work of a thread since its last check.
class Watch {
 public:
  static Watch& local();

  /// Announces work, in multiplications. Checks after some 100 µs of work.
  void spend(int64_t work) {
    left_ -= work;
    if (left_ < 0) look();
  }
  /// Checks now.
  void look();
  /// How often work of this size may be done between two checks.
  static int64_t at_once(int64_t work) { return work >= kAtOnce ? 1 : kAtOnce / (work > 0 ? work : 1); }

  /// While it lives, this thread works on a part of something that `stop` says has been given up.
  class Member {
   public:
    explicit Member(const std::atomic<bool>& stop);
    Member(const Member&) = delete;
    ~Member() { watch_.stop_ = before_; }

   private:
    Watch& watch_;
    const std::atomic<bool>* before_;
  };

 private:
  static constexpr int64_t kBudget = int64_t{1} << 18, kAtOnce = int64_t{1} << 22;

  int64_t left_ = kBudget;
  std::chrono::steady_clock::time_point next_check_{};
  const std::atomic<bool>* stop_ = nullptr;
  bool checking_ = false;
};

#ifdef __SANITIZE_THREAD__
/// at::parallel_for on threads of its own. ThreadSanitizer takes the hand-over of a loop for a race in torch's OpenMP
/// library, which is built without it.
template <class Body>
void share(int64_t begin, int64_t end, int64_t grain, const Body& body) {
  if (begin >= end) return;
  const int64_t parts = std::min<int64_t>(at::get_num_threads(), at::divup(end - begin, std::max<int64_t>(grain, 1)));
  const int64_t size = at::divup(end - begin, parts);
  std::vector<std::exception_ptr> thrown(static_cast<size_t>(parts));
  const auto run = [&](int64_t part) {
    try {
      body(begin + part * size, std::min(end, begin + (part + 1) * size));
    } catch (...) {
      thrown[static_cast<size_t>(part)] = std::current_exception();
    }
  };
  {
    std::vector<std::jthread> others;
    for (int64_t part = 1; part * size < end - begin; ++part) others.emplace_back(run, part);
    run(0);
  }
  for (const auto& exception : thrown)
    if (exception) std::rethrow_exception(exception);
}
#else
template <class Body>
void share(int64_t begin, int64_t end, int64_t grain, const Body& body) {
  at::parallel_for(begin, end, grain, body);
}
#endif

/// at::parallel_for, all of whose threads stop soon after one of them has thrown.
template <class Body>
void parallel_for(int64_t begin, int64_t end, int64_t grain, const Body& body) {
  std::atomic<bool> stop = false;
  share(begin, end, grain, [&](int64_t from, int64_t to) {
    const Watch::Member member(stop);
    try {
      body(from, to);
    } catch (const Stopped&) {  // the caller gets what made the others stop
    } catch (...) {
      stop = true;
      throw;
    }
  });
}

}  // namespace prdp::interruption
