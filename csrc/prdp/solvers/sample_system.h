#pragma once
#include <memory>

#include "prdp/kernels/preconditioner.h"
#include "prdp/solvers/solver.h"

namespace prdp {

/// A of one sample, or of all, with its preconditioner, for one thread.
template <class T>
class SampleSystem {
 public:
  /// `factors`: of a direct method, else null. `transpose`: the kernel of Aᵀ, where M⁻ᵀ is needed. False if A has no
  /// preconditioner of this kind, as a diagonal is zero.
  bool set(const kernels::Kernel<T>& a, const Preconditioner& preconditioner,
           std::shared_ptr<const kernels::Factors<T>> factors = nullptr,
           const kernels::Kernel<T>* transpose = nullptr) {
    a_ = &a;
    factors_ = std::move(factors);
    by_diagonal_ = preconditioner.is_diagonal();
    preconditioner_.reset();
    if (by_diagonal_) preconditioner_ = std::make_unique<kernels::DiagonalPreconditioner<T>>(a);
    else if (preconditioner.is_multigrid()) preconditioner_ = a.multigrid(transpose, preconditioner.smoothing());
    return preconditioner_ || !preconditioner;
  }

  const kernels::Kernel<T>& a() const { return *a_; }
  /// out = A v
  void apply(const T* v, T* out) const {
    if (!factors_ || !factors_->has_product(v, out)) a_->apply(v, out);
  }
  /// Null: none.
  kernels::Preconditioner<T>* preconditioner() const { return preconditioner_.get(); }
  /// Whether M is the diagonal of A.
  bool by_diagonal() const { return by_diagonal_; }
  const kernels::Factors<T>& factors() const { return *factors_; }

 private:
  const kernels::Kernel<T>* a_ = nullptr;
  std::shared_ptr<const kernels::Factors<T>> factors_;
  std::unique_ptr<kernels::Preconditioner<T>> preconditioner_;
  bool by_diagonal_ = false;
};

}  // namespace prdp
