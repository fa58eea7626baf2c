#pragma once
#include <algorithm>
#include <cmath>
#include <numeric>
#include <vector>

#include "prdp/kernels/layout.h"
#include "prdp/kernels/whole_vectors.h"

namespace prdp::kernels {

/// Vectors that A maps to zero: the same in each of some fields of a sample, or vectors of several fields together.
template <class T>
class NullSpace {
 public:
  /// `basis`: orthonormal vectors of `span` fields, contiguous, one after the other. The fields are those from `first`
  /// on.
  NullSpace(const Layout<T>& layout, int64_t first, int64_t fields, const std::vector<std::vector<double>>& basis,
            int64_t span = 1)
      : layout_(layout), first_(first), fields_(fields), span_(span) {
    const int64_t points = layout.rows * layout.nx;
    for (const auto& q : basis) {
      const std::vector<T> v(q.begin(), q.end());
      basis_.emplace_back(span * layout.plane, T(0));
      for (int64_t f = 0; f < span; ++f)
        loops<T>().copy_rows(T(1), v.data() + f * points, layout.nx, basis_.back().data() + f * layout.plane,
                             layout.row, layout.rows, layout.nx);
      support_.push_back(support_of(basis_.back()));
    }
  }
  /// Takes off the part of v in the null space, but for parts along one of its vectors that are no larger than
  /// `negligible`; returns the norm of what it takes off.
  T project(T* v, T negligible = 0) const {
    double part2 = 0;
    for (int64_t f = first_; f < first_ + fields_; f += span_)
      for (size_t k = 0; k < basis_.size(); ++k) {
        const auto [begin, length] = support_[k];
        const T* q = basis_[k].data() + begin;
        T* field = v + f * layout_.plane + begin;
        const T along = vectors_.dot(q, field, length);
        if (std::abs(along) <= negligible) continue;
        vectors_.axpy(-along, q, field, length);
        part2 += static_cast<double>(along) * static_cast<double>(along);
      }
    return static_cast<T>(std::sqrt(part2));
  }

  /// Orthonormal vectors of one field, contiguous, that span what the basis has there: null vectors of an operator that
  /// is the same for every field.
  std::vector<std::vector<double>> in_one_field() const {
    std::vector<std::vector<double>> all;
    for (const auto& q : basis_)
      for (int64_t f = 0; f < span_; ++f) {
        std::vector<T> part(layout_.rows * layout_.nx);
        loops<T>().copy_rows(T(1), q.data() + f * layout_.plane, layout_.row, part.data(), layout_.nx, layout_.rows,
                             layout_.nx);
        std::vector<double> v(part.begin(), part.end());
        if (span_ == 1 || is_new(all, v)) all.push_back(std::move(v));
      }
    return all;
  }
  int64_t count_in_one_field() const { return span_ == 1 ? std::ssize(basis_) : std::ssize(in_one_field()); }

 private:
  /// From the first entry to the last one that is not zero, in whole registers.
  struct Support {
    int64_t begin, length;
  };
  static Support support_of(const std::vector<T>& q) {
    constexpr int64_t whole = 16;
    const auto is_there = [](T x) { return x != T(0); };
    const auto end = static_cast<int64_t>(q.rend() - std::find_if(q.rbegin(), q.rend(), is_there));
    const auto first = static_cast<int64_t>(std::find_if(q.begin(), q.end(), is_there) - q.begin());
    const int64_t begin = std::min(first, end) / whole * whole;
    return {begin, std::min((end + whole - 1) / whole * whole, std::ssize(q)) - begin};
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
  std::vector<std::vector<T>> basis_;
  std::vector<Support> support_;
  WholeVectors<T> vectors_;
};

}  // namespace prdp::kernels
