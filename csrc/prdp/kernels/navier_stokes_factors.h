#pragma once
#include "prdp/kernels/navier_stokes.h"
#include "prdp/kernels/stencil_factors.h"

namespace prdp::kernels {

/// Sparse LU with the last pressure held at zero and its equation left out, which the others imply.
/// Right-hand side and solution are projected onto mean(p) = 0.
template <class T>
class NavierStokesFactors {
 public:
  explicit NavierStokesFactors(const NavierStokes<T>& kernel)
      : kernel_(kernel), values_(kernel.unknowns()), lu_(kernel, kernel.unknowns() - 1) {}
  bool solve(const T* r, T* d) const {
    if (!lu_.is_regular()) return false;
    const auto n = static_cast<int64_t>(values_.size());
    kernel_.store(r, T(1), values_.data());
    Eigen::VectorXd x = values_.template cast<double>();
    auto pressure = x.tail(n / 3);
    pressure.array() -= pressure.mean();
    x.head(n - 1) = lu_.solve(x.head(n - 1)).eval();
    x[n - 1] = 0.0;
    pressure.array() -= pressure.mean();
    values_ = x.template cast<T>();
    kernel_.load(values_.data(), T(1), d);
    return all_finite(values_.data(), n);
  }

 private:
  const NavierStokes<T>& kernel_;
  mutable Eigen::Matrix<T, Eigen::Dynamic, 1> values_;  // one object a thread
  SparseFactors<double> lu_;
};

template <class T>
struct FactorsOf<NavierStokes<T>> {
  using Type = NavierStokesFactors<T>;
};

}  // namespace prdp::kernels
