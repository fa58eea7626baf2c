#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

/// Plain loops over the vectors of one sample. Vectors are padded with zeros to a multiple of
/// kLanes, so that the compiler may use full vector registers without changing any sum.
namespace prdp::kernels {

template <class T>
inline constexpr int64_t kLanes = 64 / static_cast<int64_t>(sizeof(T));

template <class T>
int64_t round_up_to_lanes(int64_t n) {
  return (n + kLanes<T> - 1) / kLanes<T> * kLanes<T>;
}

/// Sum of `Width` partial sums, pairwise, so that the order never depends on the vector length.
template <class T, int64_t Width>
T pairwise_sum(T (&part)[Width]) {
  for (int64_t half = Width / 2; half > 0; half /= 2)
    for (int64_t l = 0; l < half; ++l) part[l] += part[l + half];
  return part[0];
}

template <class T>
T dot(const T* a, const T* b, int64_t n) {
  constexpr int64_t width = 4 * kLanes<T>;
  T part[width] = {};
  int64_t i = 0;
  for (; i + width <= n; i += width)
    for (int64_t l = 0; l < width; ++l) part[l] += a[i + l] * b[i + l];
  for (int64_t l = 0; i + l < n; ++l) part[l] += a[i + l] * b[i + l];
  return pairwise_sum(part);
}

/// y += alpha x
template <class T>
void axpy(T alpha, const T* __restrict x, T* __restrict y, int64_t n) {
  for (int64_t i = 0; i < n; ++i) y[i] += alpha * x[i];
}

/// y = x + beta y
template <class T>
void xpby(const T* __restrict x, T beta, T* __restrict y, int64_t n) {
  for (int64_t i = 0; i < n; ++i) y[i] = x[i] + beta * y[i];
}

/// x += alpha p and r -= alpha q in one pass; returns ‖r‖². p may be r itself.
template <class T>
T descend(T alpha, const T* p, const T* q, T* x, T* r, int64_t n) {
  constexpr int64_t width = kLanes<T>;
  T part[width] = {};
  for (int64_t i = 0; i < n; i += width) {
#pragma GCC ivdep
    for (int64_t l = 0; l < width; ++l) {
      x[i + l] += alpha * p[i + l];
      r[i + l] -= alpha * q[i + l];
      part[l] += r[i + l] * r[i + l];
    }
  }
  return pairwise_sum(part);
}

/// Largest magnitude of x as its bits: they order like the numbers, and NaN and Inf come out on top.
inline uint32_t largest_bits(const float* x, int64_t n) {
  uint32_t largest = 0;
  for (int64_t i = 0; i < n; ++i) {
    uint32_t bits;
    std::memcpy(&bits, x + i, sizeof bits);
    bits &= 0x7fffffffu;
    largest = bits > largest ? bits : largest;
  }
  return largest;
}
inline uint64_t largest_bits(const double* x, int64_t n) {
  uint64_t largest = 0;
  for (int64_t i = 0; i < n; ++i) {
    uint64_t bits;
    std::memcpy(&bits, x + i, sizeof bits);
    bits &= 0x7fffffffffffffffu;
    largest = bits > largest ? bits : largest;
  }
  return largest;
}

/// max |x_i|; NaN or Inf if any x_i is not finite.
template <class T>
T largest_magnitude(const T* x, int64_t n) {
  const auto bits = largest_bits(x, n);
  T value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

/// Power of two s with s·magnitude in [1, 2) (near the subnormals, as close as s and 1/s allow).
template <class T>
T power_of_two_scale(T magnitude) {
  constexpr int limit = std::numeric_limits<T>::max_exponent - 2;
  int exponent = std::ilogb(magnitude);
  exponent = exponent > limit ? limit : exponent < -limit ? -limit : exponent;
  return std::ldexp(T(1), -exponent);
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
    stride_ = round_up_to_lanes<T>(length) + 2 * halo;
    halo_ = halo;
    count_ = count;
    const auto needed = static_cast<size_t>(count * stride_ + kLanes<T>);
    if (memory_.size() < needed) memory_.resize(needed);
    for (int64_t i = 0; i < count; ++i) clear(i);
  }
  /// Zeroes a vector with its halos and padding.
  void clear(int64_t index) {
    std::memset(vector(index) - halo_, 0, static_cast<size_t>(stride_) * sizeof(T));
  }
  int64_t count() const { return count_; }

  T* vector(int64_t index) {
    auto address = reinterpret_cast<std::uintptr_t>(memory_.data());
    address = (address + 63) / 64 * 64;
    return reinterpret_cast<T*>(address) + index * stride_ + halo_;
  }

 private:
  std::vector<T> memory_;
  int64_t stride_ = 0, halo_ = 0, count_ = 0;
};

}  // namespace prdp::kernels
