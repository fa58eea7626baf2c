// What this machine can do, one thread: fused multiply-adds, and sums of floats read from each level of
// memory. Prints JSON. Built by roofline.py with -O3 -march=native.
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <vector>

namespace {

// Wider vectors than the processor's registers go through memory.
#ifdef __AVX512F__
constexpr int kBytes = 64;
#else
constexpr int kBytes = 32;
#endif
constexpr int kLanes = kBytes / static_cast<int>(sizeof(float));
using Lanes [[gnu::vector_size(kBytes)]] = float;
using Clock = std::chrono::steady_clock;

template <class Work>
double best_seconds(const Work& work) {
  double best = 1e9;
  for (int round = 0; round < 9; ++round) {
    const auto began = Clock::now();
    work();
    best = std::min(best, std::chrono::duration<double>(Clock::now() - began).count());
  }
  return best;
}

double gflops() {
  constexpr int kChains = kBytes == 64 ? 20 : 12, kSteps = 2'000'000;
  Lanes chains[kChains] = {};
  volatile float unknown = 0.999f;  // to the compiler
  const Lanes scale = Lanes{} + unknown, shift = Lanes{} + (1 - unknown);
  const double seconds = best_seconds([&] {
    for (int step = 0; step < kSteps; ++step)
#pragma GCC unroll 20
      for (int c = 0; c < kChains; ++c) chains[c] = chains[c] * scale + shift;
  });
  volatile float sink = 0;
  for (const auto& chain : chains) sink = sink + chain[0];
  return 2.0 * kLanes * kChains * kSteps / seconds / 1e9;
}

double gigabytes_per_second(size_t bytes) {
  const size_t count = bytes / sizeof(Lanes);
  std::vector<Lanes> values(count, Lanes{} + 1.0f);
  const size_t passes = std::max<size_t>(1, (256u << 20) / bytes);
  volatile float sink = 0;
  const double seconds = best_seconds([&] {
    for (size_t pass = 0; pass < passes; ++pass) {
      Lanes sums[8] = {};
      for (size_t i = 0; i + 8 <= count; i += 8) {
#pragma GCC unroll 8
        for (int j = 0; j < 8; ++j) sums[j] += values[i + j];
      }
      for (int j = 1; j < 8; ++j) sums[0] += sums[j];
      sink = sink + sums[0][0];
      asm volatile("" ::: "memory");
    }
  });
  return static_cast<double>(passes) * static_cast<double>(count * sizeof(Lanes)) / seconds / 1e9;
}

}  // namespace

int main() {
  std::printf("{\"gflops\": %.1f, \"gb_per_s\": {\"L1\": %.1f, \"L2\": %.1f, \"L3\": %.1f, \"memory\": %.1f}}\n",
              gflops(), gigabytes_per_second(24u << 10), gigabytes_per_second(512u << 10),
              gigabytes_per_second(8u << 20), gigabytes_per_second(512u << 20));
}
