#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/gpu/device/arguments.h"

/// The threads that work on one sample together. Everything here is the text of a GPU: __syncthreads(), threadIdx and
/// the like are the language's. tests/fibers runs it on a CPU.
namespace prdp::gpu {

inline constexpr int kWarp = 32;
/// Several loads are under way before the first of their values is needed.
inline constexpr int kCellsAtOnce = 4;

/// The threads of a block, or of several blocks that meet in memory. Each thread owns the same cells throughout, so
/// what it alone writes and reads needs no barrier.
template <int kBlocks, int kThreads>
class Team {
  static constexpr int kWarps = kThreads / kWarp;
  static_assert(kThreads % kWarp == 0 && kWarps <= kWarp);

 public:
  Team(int rank, unsigned* arrived, double* parts) : rank_(rank), arrived_(arrived), parts_(parts) {}

  bool is_first_block() const { return rank_ == 0; }
  bool leads() const { return rank_ == 0 && threadIdx.x == 0; }

  /// f(i), and then store(i, f(i)), for each of this thread's share of 0 … n - 1. f only reads, and may be called
  /// twice.
  template <int kAtOnce = kCellsAtOnce, class F, class Store>
  void each(int n, const F& f, const Store& store) const {
    const Share mine = share_of(n);
    PRDP_NO_UNROLL for (int first = mine.begin + static_cast<int>(threadIdx.x); first < mine.end;
                        first += kThreads * kAtOnce) {
      if (kAtOnce > 1 && mine.end - mine.begin <= kThreads) return store(first, f(first));
      decltype(f(0)) value[kAtOnce];
      PRDP_UNROLL for (int k = 0; k < kAtOnce; ++k) {
        const int i = first + k * kThreads;
        value[k] = f(i < mine.end ? i : first);  // without a branch, at which loads would wait
      }
      PRDP_UNROLL for (int k = 0; k < kAtOnce; ++k) if (first + k * kThreads < mine.end)
          store(first + k * kThreads, value[k]);
    }
  }

  /// f(i) likewise, one after the other.
  template <class F>
  void for_each(int n, const F& f) const {
    const Share mine = share_of(n);
    PRDP_NO_UNROLL for (int i = mine.begin + static_cast<int>(threadIdx.x); i < mine.end; i += kThreads) f(i);
  }

  /// Waits for all threads of the team, and sees what they wrote: the fences empty the block's cache. Tests leave out
  /// the one of a line, and must notice.
  void meet([[maybe_unused]] int line = __builtin_LINE()) {
    if (PRDP_LEAVES_OUT(line)) return;
    __syncthreads();
    if constexpr (kBlocks > 1) {
      if (threadIdx.x == 0) {
        awaited_ += kBlocks;
        __threadfence();
        atomicAdd(arrived_, 1u);
        [[maybe_unused]] int64_t since = 0;
        while (static_cast<int>(*static_cast<volatile unsigned*>(arrived_) - awaited_) < 0) PRDP_SPIN;
        __threadfence();
      }
      __syncthreads();
    }
  }

  /// Each s becomes its sum over the team, in an order that is always the same, with the same bits in every thread. No
  /// thread leaves before all have come.
  template <int n, class T>
  void sum(T (&s)[n]) {
    reduce(s, [](T a, T b) { return a + b; });
  }
  template <class T>
  T sum(T value) {
    T s[1] = {value};
    sum(s);
    return s[0];
  }
  /// The largest of numbers that are not negative; infinite if one of them is not finite.
  template <class T>
  T largest(T value) {
    T s[1] = {std::isfinite(value) ? value : std::numeric_limits<T>::infinity()};
    reduce(s, [](T a, T b) { return a > b ? a : b; });
    return s[0];
  }

 private:
  struct Share {
    int begin, end;
  };
  /// What this block takes of 0 … n - 1.
  Share share_of(int n) const {
    if constexpr (kBlocks == 1) return {0, n};
    const int share = (n + kBlocks - 1) / kBlocks, begin = share * rank_;
    return {begin, begin + share < n ? begin + share : n};
  }
  /// Every lane gets the same bits, as both of a pair add the same two numbers.
  template <class T, class Join>
  static T over_warp(T v, const Join& join) {
    for (int lane = kWarp / 2; lane > 0; lane /= 2) v = join(v, __shfl_xor_sync(~0u, v, lane));
    return v;
  }

  /// join(v, 0) must be v.
  template <int n, class T, class Join>
  PRDP_NOINLINE void reduce(T (&s)[n], const Join& join) {
    static_assert(n <= kMostAtOnce);
    // Two of each, in turn: the next sum may begin while a slow thread still reads this one.
    __shared__ T of_warps[2][n][kWarp];
    turn_ ^= 1;
    const int lane = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
    for (int k = 0; k < n; ++k) {
      s[k] = over_warp(s[k], join);
      if (kWarps > 1 && lane == 0) of_warps[turn_][k][warp] = s[k];
    }
    __syncthreads();
    if constexpr (kWarps > 1)
      for (int k = 0; k < n; ++k) s[k] = over_warp(lane < kWarps ? of_warps[turn_][k][lane] : T(0), join);
    if constexpr (kBlocks > 1) over_blocks(s, join);
  }
  template <int n, class T, class Join>
  void over_blocks(T (&s)[n], const Join& join) {
    __shared__ T whole[2][kMostAtOnce];
    double* const parts = parts_ + turn_ * kBlocks * kMostAtOnce;
    if (threadIdx.x == 0)
      for (int k = 0; k < n; ++k) parts[rank_ * kMostAtOnce + k] = static_cast<double>(s[k]);
    meet();
    if (const int lane = static_cast<int>(threadIdx.x); lane < kWarp) {
      T of_lane[n];
      PRDP_UNROLL for (int k = 0; k < n; ++k) of_lane[k] = T(0);
      PRDP_UNROLL for (int first = 0; first < kBlocks; first += kWarp) PRDP_UNROLL for (int k = 0; k < n; ++k) {
        const int block = first + lane;
        of_lane[k] = join(of_lane[k], block < kBlocks ? static_cast<T>(parts[block * kMostAtOnce + k]) : T(0));
      }
      for (int k = 0; k < n; ++k)
        if (const T all = over_warp(of_lane[k], join); lane == 0) whole[turn_][k] = all;
    }
    __syncthreads();
    for (int k = 0; k < n; ++k) s[k] = whole[turn_][k];
  }

  int rank_;
  unsigned* arrived_;
  double* parts_;
  unsigned awaited_ = 0;
  int turn_ = 0;
};

/// The body of a kernel: f(sample, team, its number) for each of the samples, one after the other for each team.
/// `arguments` say where the blocks of teams meet.
template <int kBlocks, int kThreads, class Arguments, class F>
void for_samples_of_team(const Arguments& arguments, int64_t samples, const F& f) {
  const int number = static_cast<int>(blockIdx.x) / kBlocks, rank = static_cast<int>(blockIdx.x) % kBlocks;
  Team<kBlocks, kThreads> team(rank, arguments.arrived + kArrivedOfTeam * number,
                               arguments.parts + kPartsOfBlock * kBlocks * number);
  for (int64_t sample = number; sample < samples; sample += static_cast<int>(gridDim.x) / kBlocks)
    f(sample, team, number);
}

}  // namespace prdp::gpu
