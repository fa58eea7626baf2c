#pragma once
#include <ATen/Parallel.h>

#include <atomic>
#include <chrono>
#ifdef __SANITIZE_THREAD__
#include <sanitizer/tsan_interface.h>
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
/// What ThreadSanitizer cannot see, because torch's OpenMP library is built without it: a parallel loop begins after
/// what was done before it, and ends before what is done after it. Nothing is said about parts of the same loop.
class ForkAndJoin {
 public:
  ForkAndJoin() { __tsan_release(&begun_); }
  ~ForkAndJoin() { __tsan_acquire(&ended_); }
  struct Part {
    explicit Part(const ForkAndJoin& loop) : loop(loop) { __tsan_acquire(&loop.begun_); }
    ~Part() { __tsan_release(&loop.ended_); }
    const ForkAndJoin& loop;
  };

 private:
  mutable char begun_ = 0, ended_ = 0;
};
#else
struct ForkAndJoin {
  struct Part {
    explicit Part(const ForkAndJoin&) {}
  };
};
#endif

/// at::parallel_for, all of whose threads stop soon after one of them has thrown.
template <class Body>
void parallel_for(int64_t begin, int64_t end, int64_t grain, const Body& body) {
  std::atomic<bool> stop = false;
  const ForkAndJoin order;
  at::parallel_for(begin, end, grain, [&](int64_t from, int64_t to) {
    const ForkAndJoin::Part part(order);
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
