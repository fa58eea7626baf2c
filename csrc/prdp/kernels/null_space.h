#pragma once
#include <cmath>
#include <vector>

#include "prdp/kernels/layout.h"
#include "prdp/kernels/whole_vectors.h"

namespace prdp::kernels {

/// Vectors that A maps to zero, the same in each of some fields of a sample.
template <class T>
class NullSpace {
 public:
  /// `basis`: orthonormal vectors of one field, contiguous, one after the other. The fields are those from `first` on.
  NullSpace(const Layout<T>& layout, int64_t first, int64_t fields, const std::vector<std::vector<double>>& basis)
      : layout_(layout), first_(first), fields_(fields) {
    for (const auto& q : basis) {
      const std::vector<T> v(q.begin(), q.end());
      basis_.emplace_back(layout.plane, T(0));
      loops<T>().copy_rows(T(1), v.data(), layout.nx, basis_.back().data(), layout.row, layout.rows, layout.nx);
    }
  }
  /// Takes off the part of v in the null space; returns the norm of that part.
  T project(T* v) const {
    double part2 = 0;
    for (int64_t f = first_; f < first_ + fields_; ++f)
      for (const auto& q : basis_) {
        T* field = v + f * layout_.plane;
        const T along = vectors_.dot(q.data(), field, layout_.plane);
        vectors_.axpy(-along, q.data(), field, layout_.plane);
        part2 += static_cast<double>(along) * static_cast<double>(along);
      }
    return static_cast<T>(std::sqrt(part2));
  }

  int64_t count() const { return std::ssize(basis_); }
  /// The basis as contiguous vectors of one field.
  std::vector<std::vector<double>> contiguous() const {
    std::vector<std::vector<double>> all;
    for (const auto& q : basis_) {
      std::vector<T> v(layout_.rows * layout_.nx);
      loops<T>().copy_rows(T(1), q.data(), layout_.row, v.data(), layout_.nx, layout_.rows, layout_.nx);
      all.emplace_back(v.begin(), v.end());
    }
    return all;
  }

 private:
  Layout<T> layout_;
  int64_t first_, fields_;
  std::vector<std::vector<T>> basis_;
  WholeVectors<T> vectors_;
};

}  // namespace prdp::kernels
