#pragma once
#include <algorithm>
#include <array>
#include <cstring>
#include <memory>
#include <utility>
#include <vector>

#include "prdp/kernels/loops.h"
#include "prdp/threads/share_rows.h"

namespace prdp::kernels {

using share_rows::kBlock;

/// Allocates memory without a value. New pages are most of what it costs to set up a large grid, and whoever writes to
/// them first pays: so all threads fill a field, each its part.
template <class T>
struct Unset : std::allocator<T> {
  template <class U>
  struct rebind {
    using other = Unset<U>;
  };
  template <class U>
  void construct(U* at) {
    ::new (static_cast<void*>(at)) U;
  }
  template <class U, class... Values>
  void construct(U* at, Values&&... values) {
    ::new (static_cast<void*>(at)) U(std::forward<Values>(values)...);
  }
};

/// The coefficients, weights or values of a grid.
template <class T>
using Field = std::vector<T, Unset<T>>;

/// Calls body(begin, end) for each block of n values.
template <class Body>
void for_each_block_of(int64_t n, const Body& body) {
  if (n <= kBlock) return body(int64_t{0}, n);
  share_rows::for_each((n + kBlock - 1) / kBlock, [&](int64_t i) { body(i * kBlock, std::min(n, (i + 1) * kBlock)); });
}

/// Calls body(begin, end) for runs of rows with n values each.
template <class Body>
void for_each_run_of_rows(int64_t rows, int64_t n, const Body& body) {
  const int64_t each = std::max<int64_t>(kBlock / n, 1);
  if (rows <= each) return body(int64_t{0}, rows);
  share_rows::for_each((rows + each - 1) / each, [&](int64_t i) { body(i * each, std::min(rows, (i + 1) * each)); });
}

template <class T>
void fill_zero(T* x, int64_t n) {
  for_each_block_of(n, [&](int64_t i, int64_t end) { std::memset(x + i, 0, (end - i) * sizeof(T)); });
}

template <class T>
Field<T> zeros(int64_t n) {
  Field<T> field(n);
  fill_zero(field.data(), n);
  return field;
}

/// The largest of what of_block(begin, end) says of each block; NaN or Inf if that of any block is.
template <class T, class Body>
T largest_of_blocks(int64_t n, const Body& of_block) {
  if (n <= kBlock) return of_block(int64_t{0}, n);
  std::vector<T> all((n + kBlock - 1) / kBlock);
  for_each_block_of(n, [&](int64_t i, int64_t end) { all[i / kBlock] = of_block(i, end); });
  return loops<T>().largest_magnitude(all.data(), static_cast<int64_t>(all.size()));
}

/// max |x_i|; NaN or Inf if any x_i is not finite.
template <class T>
T largest_magnitude(const T* x, int64_t n) {
  return largest_of_blocks<T>(n, [&](int64_t i, int64_t end) { return loops<T>().largest_magnitude(x + i, end - i); });
}

/// Sums of several numbers over parts: body(i, sums) adds those of part i to zeros.
template <class T, size_t Count, class Body>
std::array<T, Count> sums_over(int64_t parts, const Body& body) {
  std::array<T, Count> sums{};
  if (parts == 1) {
    body(int64_t{0}, sums.data());
    return sums;
  }
  constexpr int64_t few = 16, count = Count;
  T of_few[few * count] = {};
  std::vector<T> of_many(parts > few ? parts * count : 0);
  T* const of_parts = parts > few ? of_many.data() : of_few;
  share_rows::for_each(parts, [&](int64_t i) { body(i, of_parts + i * count); });
  for (int64_t c = 0; c < count; ++c) {
    double sum = 0;
    for (int64_t i = 0; i < parts; ++i) sum += static_cast<double>(of_parts[i * count + c]);
    sums[c] = static_cast<T>(sum);
  }
  return sums;
}

/// The loops over whole padded vectors of n values, in blocks that several threads may share.
template <class T>
class WholeVectors {
 public:
  void copy(const T* from, T* to, int64_t n) const {
    for_each_block_of(n, [&](int64_t i, int64_t end) { std::memcpy(to + i, from + i, (end - i) * sizeof(T)); });
  }
  void fill_zero(T* x, int64_t n) const { kernels::fill_zero(x, n); }
  void scale(T factor, const T* x, T* out, int64_t n) const {
    for_each_block_of(n, [&](int64_t i, int64_t end) { loops_.scale(factor, x + i, out + i, end - i); });
  }
  /// The same in one pass; returns w·out and ‖out‖².
  std::array<T, 2> scale_with_dots(T factor, const T* x, const T* w, T* out, int64_t n) const {
    return sums_over<T, 2>((n + kBlock - 1) / kBlock, [&](int64_t p, T* dots) {
      const int64_t i = p * kBlock;
      loops_.scale_with_dots(factor, x + i, w + i, out + i, dots, std::min(n - i, kBlock));
    });
  }
  void axpy(T alpha, const T* x, T* y, int64_t n) const {
    for_each_block_of(n, [&](int64_t i, int64_t end) { loops_.axpy(alpha, x + i, y + i, end - i); });
  }
  T dot(const T* a, const T* b, int64_t n) const {
    return sum(n, [&](int64_t i, int64_t end) { return loops_.dot(a + i, b + i, end - i); });
  }
  /// y = x + beta y; and the same, returning ‖y‖².
  void xpby(const T* x, T beta, T* y, int64_t n) const {
    for_each_block_of(n, [&](int64_t i, int64_t end) { loops_.xpby(x + i, beta, y + i, end - i); });
  }
  T xpby_with_square(const T* x, T beta, T* y, int64_t n) const {
    return sum(n, [&](int64_t i, int64_t end) { return loops_.xpby_with_square(x + i, beta, y + i, end - i); });
  }
  /// x += alpha p and r -= alpha q; returns ‖r‖². p may be r.
  T update_iterate_and_residual(T alpha, const T* p, const T* q, T* x, T* r, int64_t n) const {
    return sum(n, [&](int64_t i, int64_t end) {
      return loops_.update_iterate_and_residual(alpha, p + i, q + i, x + i, r + i, end - i);
    });
  }
  /// out = w∘x, entry by entry; returns x·out.
  T weigh(const T* w, const T* x, T* out, int64_t n) const {
    return sum(n, [&](int64_t i, int64_t end) { return loops_.weigh(w + i, x + i, out + i, end - i); });
  }
  /// h_j = v_j·(factor·w) for `count` vectors, at least one.
  void multi_dot(const T* const* v, int64_t count, T factor, const T* w, T* h, int64_t n) const {
    if (n <= kBlock) return loops_.multi_dot(v, count, factor, w, h, n);
    const int64_t parts = (n + kBlock - 1) / kBlock;
    std::vector<T> of_parts(parts * count);
    share_rows::for_each(parts, [&](int64_t p) {
      const int64_t i = p * kBlock;
      loops_.multi_dot(moved(v, count, i).data(), count, factor, w + i, of_parts.data() + p * count,
                       std::min(n - i, kBlock));
    });
    for (int64_t j = 0; j < count; ++j) {
      double sum = 0;
      for (int64_t p = 0; p < parts; ++p) sum += static_cast<double>(of_parts[p * count + j]);
      h[j] = static_cast<T>(sum);
    }
  }
  /// w = factor·w + sign·Σ alpha_j v_j; returns ‖w‖².
  T multi_axpy(T sign, const T* alpha, const T* const* v, int64_t count, T factor, T* w, int64_t n) const {
    if (n <= kBlock) return loops_.multi_axpy(sign, alpha, v, count, factor, w, n);
    return sum(n, [&](int64_t i, int64_t end) {
      return loops_.multi_axpy(sign, alpha, moved(v, count, i).data(), count, factor, w + i, end - i);
    });
  }
  T largest_magnitude(const T* x, int64_t n) const { return kernels::largest_magnitude(x, n); }

 private:
  static std::vector<const T*> moved(const T* const* v, int64_t count, int64_t by) {
    std::vector<const T*> from(v, v + count);
    for (auto& p : from) p += by;
    return from;
  }
  template <class Body>
  static T sum(int64_t n, const Body& of_block) {
    if (n <= kBlock) return of_block(int64_t{0}, n);
    return sums_over<T, 1>((n + kBlock - 1) / kBlock, [&](int64_t p, T* sums) {
      sums[0] = of_block(p * kBlock, std::min(n, (p + 1) * kBlock));
    })[0];
  }

  const Loops<T>& loops_ = loops<T>();
};

}  // namespace prdp::kernels
