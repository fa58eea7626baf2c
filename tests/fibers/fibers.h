#pragma once
#include <link.h>
#include <ucontext.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <numeric>
#include <random>
#include <thread>
#include <utility>
#include <vector>

/// The text of a GPU kernel on a CPU, without a GPU: the threads of a block are fibers of one host thread, which give
/// way at barriers and shuffles, and the blocks are host threads. Between two barriers the fibers run in a given order:
/// forward, backward or shuffled. What depends on the order shows in the bits; memory of a block begins as NaN in each
/// launch; fibers that wait at different barriers, or called by different lines, are an error.
#define __device__
#define __global__
#define __grid_constant__
#define __launch_bounds__(threads)
#define __shared__ static thread_local
#define PRDP_UNROLL
#define PRDP_NOINLINE
#define PRDP_NO_UNROLL
#define PRDP_SPIN fibers::spin(since)
#define PRDP_BLOCK_MEMORY(name) double* const name = reinterpret_cast<double*>(fibers::block->memory.data())
// One barrier may be left out, to see that a test notices: that of a line of team.h, or of a line that calls meet().
#define __syncthreads() (__LINE__ == fibers::left_out ? void() : fibers::meet(__LINE__))
#define PRDP_LEAVES_OUT(line) fibers::leaves_out(line)
#define __trap() std::abort()
#define __threadfence() std::atomic_thread_fence(std::memory_order_seq_cst)

// Under ThreadSanitizer, fibers are threads that only barriers and shuffles put into an order. What this file keeps for
// itself is no part of that.
#ifdef __SANITIZE_THREAD__
#include <sanitizer/tsan_interface.h>
extern "C" void AnnotateIgnoreReadsBegin(const char*, int);
extern "C" void AnnotateIgnoreReadsEnd(const char*, int);
extern "C" void AnnotateIgnoreWritesBegin(const char*, int);
extern "C" void AnnotateIgnoreWritesEnd(const char*, int);
namespace fibers {
constexpr unsigned kWithoutOrder = 1;
struct Unwatched {
  Unwatched() {
    AnnotateIgnoreReadsBegin(__FILE__, __LINE__);
    AnnotateIgnoreWritesBegin(__FILE__, __LINE__);
  }
  ~Unwatched() {
    AnnotateIgnoreWritesEnd(__FILE__, __LINE__);
    AnnotateIgnoreReadsEnd(__FILE__, __LINE__);
  }
};
inline void* made_fiber() { return __tsan_create_fiber(0); }
inline void* this_fiber() { return __tsan_get_current_fiber(); }
inline void switch_to(void* fiber, bool ordered) { __tsan_switch_to_fiber(fiber, ordered ? 0 : kWithoutOrder); }
inline void came_to(void* gate) { __tsan_release(gate); }
inline void left(void* gate) { __tsan_acquire(gate); }
}  // namespace fibers
#else
namespace fibers {
struct Unwatched {
  Unwatched() {}
};
inline void* made_fiber() { return nullptr; }
inline void* this_fiber() { return nullptr; }
inline void switch_to(void*, bool) {}
inline void came_to(void*) {}
inline void left(void*) {}
}  // namespace fibers
#endif

namespace fibers {

enum class Order { kForward, kBackward, kShuffled };

struct Fiber {
  ucontext_t context;
  std::unique_ptr<char[]> stack;
  bool done = false;
  int caller = 0;           // the line that last called meet() of a team
  void* watched = nullptr;  // by ThreadSanitizer
};
/// Where fibers wait for each other.
struct Gate {
  int64_t opened = 0;
  int waiting = 0;
  std::pair<int, int> place{};  // of those that wait: the line of the barrier, and that of its caller
};
struct Block {
  std::vector<Fiber> fibers;
  ucontext_t scheduler;
  void* watched = nullptr;
  int now = 0;
  std::vector<char> memory;
  std::vector<double> of_lanes;
  Gate all;
  std::vector<Gate> warps;
  bool moved = false;  // somebody has, in this round
};
inline thread_local Block* block = nullptr;
inline thread_local std::function<void()>* body = nullptr;
inline int left_out = 0;
inline bool poisons = true;  // memory of a block
inline std::atomic<bool> stuck = false;  // some block is: the others must not wait for it
inline std::atomic<int> ended = 0;       // blocks
struct Stuck {};
constexpr int kLinesOfTeam = 10000;
constexpr int kLanesOfWarp = 32;

inline void give_way() {
  auto& fiber = block->fibers[block->now];
  switch_to(block->watched, /*ordered=*/false);
  swapcontext(&fiber.context, &block->scheduler);
}
inline void wait_among(Gate& gate, int fibers, int line) {
  const Unwatched here;
  block->moved = true;
  const int64_t before = gate.opened;
  const std::pair place{line, block->fibers[block->now].caller};
  if (gate.waiting > 0 && gate.place != place) stuck = true;
  gate.place = place;
  if (++gate.waiting == fibers) {
    gate.waiting = 0;
    ++gate.opened;
    return give_way();
  }
  do give_way();
  while (gate.opened == before);
  block->moved = true;
}
inline void wait_at(Gate& gate, int fibers, int line) {
  came_to(&gate);
  wait_among(gate, fibers, line);
  left(&gate);
}
inline void meet(int line) { wait_at(block->all, static_cast<int>(block->fibers.size()), line); }
inline bool leaves_out(int line) {
  const Unwatched here;
  block->fibers[block->now].caller = line;
  return kLinesOfTeam + line == left_out;
}
/// Gives up, after a while, where a block ended that should have come.
inline void spin(int64_t& since) {
  constexpr int64_t patience = 3000;  // ms: on a busy machine the others may be late
  const auto now = std::chrono::steady_clock::now().time_since_epoch() / std::chrono::milliseconds(1);
  if (ended > 0 && since == 0) since = now;
  if (since > 0 && now - since > patience) stuck = true;
  if (stuck) throw Stuck();
  std::this_thread::yield();
}
inline void enter() {
  try {
    (*body)();
  } catch (const Stuck&) {
  }
  const Unwatched here;
  came_to(block);
  block->fibers[block->now].done = true;
  give_way();
}

}  // namespace fibers

struct Index {
  unsigned x;
};
inline thread_local Index threadIdx, blockDim, blockIdx, gridDim;

/// All lanes meet twice: when each has written, and when each has read.
template <class T>
T __shfl_xor_sync(unsigned, T value, int lane, int line = __builtin_LINE()) {
  auto& b = *fibers::block;
  auto& warp = b.warps[threadIdx.x / fibers::kLanesOfWarp];
  b.of_lanes[threadIdx.x] = static_cast<double>(value);
  fibers::wait_at(warp, fibers::kLanesOfWarp, line);
  const T other = static_cast<T>(b.of_lanes[threadIdx.x ^ static_cast<unsigned>(lane)]);
  fibers::wait_at(warp, fibers::kLanesOfWarp, -line);
  return other;
}
inline unsigned atomicAdd(unsigned* p, unsigned v) { return __atomic_fetch_add(p, v, __ATOMIC_SEQ_CST); }

namespace fibers {

/// The __shared__ variables of this thread's block, which are thread_local ones of this library, become NaN.
inline void poison_shared() {
  const auto poison = [](dl_phdr_info* library, size_t, void* mine) {
    auto* const begin = static_cast<char*>(library->dlpi_tls_data);
    for (int k = 0; begin && k < library->dlpi_phnum; ++k) {
      const auto& part = library->dlpi_phdr[k];
      if (part.p_type != PT_TLS || mine < begin || mine >= begin + part.p_memsz) continue;
      std::memset(begin, 0xff, part.p_memsz);
      return 1;
    }
    return 0;
  };
  if (dl_iterate_phdr(poison, &block) == 0) std::abort();
}

/// Runs a block to its end; false where its fibers wait at different barriers.
inline bool run_block(int index, int blocks, int threads, int64_t memory, Order order, unsigned seed,
                      std::function<void()> kernel) {
  const Unwatched here;
  Block mine;
  if (poisons) poison_shared();
  block = &mine;
  mine.watched = this_fiber();
  body = &kernel;
  mine.memory.assign(static_cast<size_t>(memory), char(0xff));
  mine.of_lanes.assign(static_cast<size_t>(threads), NAN);
  mine.warps.resize(static_cast<size_t>(threads / kLanesOfWarp));
  mine.fibers.resize(static_cast<size_t>(threads));
  blockDim.x = static_cast<unsigned>(threads);
  gridDim.x = static_cast<unsigned>(blocks);
  blockIdx.x = static_cast<unsigned>(index);
  constexpr size_t stack = size_t{1} << 17;
  for (auto& fiber : mine.fibers) {
    fiber.stack = std::make_unique_for_overwrite<char[]>(stack);
    getcontext(&fiber.context);
    fiber.context.uc_stack = {fiber.stack.get(), 0, stack};
    fiber.context.uc_link = &mine.scheduler;
    makecontext(&fiber.context, enter, 0);
    fiber.watched = made_fiber();
  }
  std::vector<int> turns(static_cast<size_t>(threads));
  std::iota(turns.begin(), turns.end(), 0);
  if (order == Order::kBackward) std::reverse(turns.begin(), turns.end());
  std::mt19937 random(seed);
  for (;;) {
    if (order == Order::kShuffled) std::shuffle(turns.begin(), turns.end(), random);
    bool any = false;
    mine.moved = false;
    for (const int turn : turns) {
      auto& fiber = mine.fibers[static_cast<size_t>(turn)];
      if (fiber.done) continue;
      any = true;
      mine.now = turn;
      threadIdx.x = static_cast<unsigned>(turn);
      switch_to(fiber.watched, /*ordered=*/true);
      swapcontext(&mine.scheduler, &fiber.context);
      mine.moved = mine.moved || fiber.done;
    }
    if (!any) {
      left(&mine);
      ++ended;
      return true;
    }
    if (!mine.moved || stuck) {
      stuck = true;
      return false;
    }
  }
}

/// Runs all blocks at the same time, each on a thread of the host.
inline bool launch(int blocks, int threads, int64_t memory, Order order, unsigned seed,
                   const std::function<void()>& kernel) {
  stuck = false;
  ended = 0;
  std::vector<char> regular(static_cast<size_t>(blocks));
  std::vector<std::thread> hosts;
  for (int k = 0; k < blocks; ++k)
    hosts.emplace_back([&, k] {
      regular[static_cast<size_t>(k)] =
          run_block(k, blocks, threads, memory, order, seed + static_cast<unsigned>(k), kernel);
    });
  for (auto& host : hosts) host.join();
  return std::all_of(regular.begin(), regular.end(), [](char one) { return one != 0; });
}

}  // namespace fibers

/// The function by which the runtime of the tests launches the kernel of a library: `call` is one of its threads.
#define PRDP_FIBERS_RUN(call)                                                                              \
  extern "C" int run(const void* arguments, int blocks, int threads, long memory, int order, int left_out, \
                     bool poisons) {                                                                       \
    fibers::left_out = left_out;                                                                           \
    fibers::poisons = poisons;                                                                             \
    return fibers::launch(blocks, threads, memory, static_cast<fibers::Order>(order), 7, [&] { call; });   \
  }
