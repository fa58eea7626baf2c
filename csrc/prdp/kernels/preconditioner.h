#pragma once
#include <vector>

#include "prdp/kernels/kernel.h"

namespace prdp::kernels {

/// M⁻¹ ≈ A⁻¹ on one sample in padded memory; for one thread at a time.
template <class T>
class Preconditioner {
 public:
  virtual ~Preconditioner() = default;
  /// z = M⁻¹ r; returns r·z.
  virtual T apply(const T* r, T* z) = 0;
  /// z = M⁻ᵀ r
  virtual void apply_transpose(const T* r, T* z) = 0;
};

/// M = D, the diagonal of A.
template <class T>
class DiagonalPreconditioner final : public Preconditioner<T> {
 public:
  /// The diagonal must have no zero.
  explicit DiagonalPreconditioner(const Kernel<T>& a) : inverse_(a.length(), T(0)) {
    const std::vector<T> ones(a.unknowns(), T(1));
    a.layout().load(ones.data(), T(1), inverse_.data());
    a.divide_by_diagonal(inverse_.data(), inverse_.data());
  }
  T apply(const T* r, T* z) override { return vectors_.weigh(inverse_.data(), r, z, length()); }
  void apply_transpose(const T* r, T* z) override { apply(r, z); }

 private:
  int64_t length() const { return static_cast<int64_t>(inverse_.size()); }

  WholeVectors<T> vectors_;
  std::vector<T> inverse_;
};

}  // namespace prdp::kernels
