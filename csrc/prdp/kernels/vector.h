#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "prdp/kernels/scales.h"
#include "prdp/kernels/whole_vectors.h"

/// Scaling, finiteness and memory of the vectors of one sample.
namespace prdp::kernels {

template <class T>
int64_t round_up_to_lanes(int64_t n) {
  return (n + kLanes<T> - 1) / kLanes<T> * kLanes<T>;
}

/// Thread-local, grow-only memory that hands out zeroed vectors of one length with zeroed halos.
template <class T>
class Workspace {
 public:
  static Workspace& local() {
    static thread_local Workspace workspace;
    return workspace;
  }

  /// Makes room for `count` vectors of `length` values with `halo` zeros on each side.
  void prepare(int64_t count, int64_t length, int64_t halo) {
    halo = round_up_to_lanes<T>(halo);
    // Vectors that start at the same place in their pages would wait for each other's stores.
    constexpr int64_t page = 4096 / sizeof(T), apart = 11 * kLanes<T>;
    stride_ = (round_up_to_lanes<T>(length) + 2 * halo + page - 1) / page * page + apart;
    used_ = round_up_to_lanes<T>(length) + 2 * halo;
    halo_ = halo;
    count_ = count;
    const auto needed = static_cast<size_t>(count * stride_ + kLanes<T>);
    if (memory_.size() < needed) memory_.resize(needed);
    for (int64_t i = 0; i < count; ++i) clear(i);
  }
  /// Zeroes a vector with its halos.
  void clear(int64_t index) { fill_zero(vector(index) - halo_, used_); }
  int64_t count() const { return count_; }

  T* vector(int64_t index) {
    auto address = reinterpret_cast<std::uintptr_t>(memory_.data());
    address = (address + 63) / 64 * 64;
    return reinterpret_cast<T*>(address) + index * stride_ + halo_;
  }

 private:
  Field<T> memory_;
  int64_t stride_ = 0, used_ = 0, halo_ = 0, count_ = 0;  // `used_` of each stride, which ends with a gap
};

}  // namespace prdp::kernels
