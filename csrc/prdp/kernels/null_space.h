#pragma once
#include <algorithm>
#include <cmath>
#include <numeric>
#include <vector>

#include "prdp/kernels/layout.h"
#include "prdp/kernels/whole_vectors.h"

namespace prdp::kernels {

/// A vector that is zero but for some entries in a row, the first of which is `begin`.
struct NullVector {
  int64_t begin = 0;
  std::vector<double> values{};
};

/// Vectors that A maps to zero: the same in each of some fields of a sample, or vectors of several fields together.
template <class T>
class NullSpace {
 public:
  /// `basis`: orthonormal vectors of `span` fields, contiguous, one after the other. The fields are those from `first`
  /// on.
  NullSpace(const Layout<T>& layout, int64_t first, int64_t fields, const std::vector<NullVector>& basis,
            int64_t span = 1)
      : layout_(layout), first_(first), fields_(fields), span_(span) {
    for (const auto& q : basis) {
      constexpr int64_t whole = 16;  // registers
      const auto count = std::ssize(q.values);
      const int64_t begin = place_of(q.begin) / whole * whole;
      const int64_t end = (place_of(q.begin + count - 1) + whole) / whole * whole;
      basis_.push_back({begin, std::vector<T>(std::min(end, span * layout.plane) - begin)});
      for (int64_t i = 0; i < count; ++i)
        basis_.back().values[place_of(q.begin + i) - begin] = static_cast<T>(q.values[i]);
    }
  }
  /// Takes off the part of v in the null space, but for parts along one of its vectors that are no larger than
  /// `negligible`; returns the norm of what it takes off.
  T project(T* v, T negligible = 0) const {
    double part2 = 0;
    for (int64_t f = first_; f < first_ + fields_; f += span_)
      for (const auto& [begin, q] : basis_) {
        T* field = v + f * layout_.plane + begin;
        const T along = vectors_.dot(q.data(), field, std::ssize(q));
        if (std::abs(along) <= negligible) continue;
        vectors_.axpy(-along, q.data(), field, std::ssize(q));
        part2 += static_cast<double>(along) * static_cast<double>(along);
      }
    return static_cast<T>(std::sqrt(part2));
  }

  /// Orthonormal vectors of one field, contiguous, that span what the basis has there: null vectors of an operator that
  /// is the same for every field.
  std::vector<std::vector<double>> in_one_field() const {
    std::vector<std::vector<double>> all;
    const int64_t points = layout_.rows * layout_.nx;
    for (const auto& [begin, q] : basis_)
      for (int64_t f = 0; f < span_; ++f) {
        std::vector<double> v(points);
        for (int64_t i = 0; i < points; ++i) {
          const int64_t at = place_of(f * points + i) - begin;
          if (at >= 0 && at < std::ssize(q)) v[i] = static_cast<double>(q[at]);
        }
        if (span_ == 1 || is_new(all, v)) all.push_back(std::move(v));
      }
    return all;
  }
  int64_t count_in_one_field() const { return span_ == 1 ? std::ssize(basis_) : std::ssize(in_one_field()); }

 private:
  /// Of entry i of a vector, in padded memory.
  int64_t place_of(int64_t i) const {
    const int64_t points = layout_.rows * layout_.nx, in_field = i % points;
    return i / points * layout_.plane + in_field / layout_.nx * layout_.row + in_field % layout_.nx;
  }

  /// Makes v orthonormal to the others; false if it depends on them.
  static bool is_new(const std::vector<std::vector<double>>& others, std::vector<double>& v) {
    const auto dot = [](const auto& a, const auto& b) {
      return std::inner_product(a.begin(), a.end(), b.begin(), 0.0);
    };
    for (int pass = 0; pass < 2; ++pass)
      for (const auto& q : others) {
        const double along = dot(q, v);
        for (size_t i = 0; i < v.size(); ++i) v[i] -= along * q[i];
      }
    const double left = std::sqrt(dot(v, v));
    for (auto& x : v) x /= left;
    constexpr double independent = 1e-5;  // of vectors whose norm is one in all fields, in any dtype
    return left > independent;
  }

  Layout<T> layout_;
  int64_t first_, fields_, span_;
  /// From the first entry to the last one that is not zero, in whole registers of padded memory.
  struct Vector {
    int64_t begin;
    std::vector<T> values;
  };
  std::vector<Vector> basis_;
  WholeVectors<T> vectors_;
};

}  // namespace prdp::kernels
