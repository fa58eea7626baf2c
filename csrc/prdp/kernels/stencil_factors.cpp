#include <optional>

#include "prdp/kernels/cyclic_thomas.h"
#include "prdp/kernels/fast_diagonalisation.h"
#include "prdp/kernels/navier_stokes.h"
#include "prdp/kernels/sparse_factors.h"
#include "prdp/kernels/stencil.h"

namespace prdp::kernels {

namespace {

/// Contiguous values in double.
template <class T>
Eigen::VectorXd values_of(const T* v, const Layout<T>& layout) {
  Eigen::Matrix<T, Eigen::Dynamic, 1> values(layout.unknowns());
  layout.store(v, T(1), values.data());
  return values.template cast<double>();
}
/// Into padded memory; false if they are not finite.
template <class T>
bool store_if_finite(const Eigen::VectorXd& x, const Layout<T>& layout, T* d) {
  const Eigen::Matrix<T, Eigen::Dynamic, 1> values = x.template cast<T>();
  layout.load(values.data(), T(1), d);
  return values.allFinite();
}

/// One factorisation for all channels. It is made in double; a sum over axes is applied in T.
template <class T>
class StencilFactors final : public Factors<T> {
 public:
  StencilFactors(const Stencil<T>& kernel, const FactorKey& key, bool transposed)
      : layout_(kernel.layout()), transposed_(transposed) {
    const auto& a = kernel.coefficients();
    if (a.pattern().nearest && a.rows() == 1 && !kernel.null_space()) thomas_.emplace(a);
    if (thomas_ && thomas_->is_dominant()) return;  // it exchanges no pivots
    thomas_.reset();
    if (a.rows() > 1)
      axes_ = fast_diagonalisation(a, key, kernel.null_space() ? kernel.null_space()->count_in_one_field() : 0);
    if (axes_) return;  // of a symmetric A, its own transpose
    sparse_ = sparse_factors(a, key, transposed, points(), pins_of(kernel.null_space(), kernel.left_null_space(), 0));
  }
  bool gains_by_several() const override { return sparse_ && sparse_->gains_by_several(); }
  bool solve(const T* r, T* d) const override {
    if (axes_) return solve_along_axes(r, d);
    if (!thomas_) return solve_several(&r, &d, 1);
    if (!thomas_->is_regular()) return false;
    Eigen::VectorXd x = values_of(r, layout_);
    for (int64_t channel = 0; channel < layout_.planes; ++channel) thomas_->solve(x.data() + channel * points());
    return store_if_finite(x, layout_, d);
  }
  bool solve_several(const T* const* r, T* const* d, int64_t count) const override {
    if (!sparse_) return Factors<T>::solve_several(r, d, count);
    if (!sparse_->is_regular()) return false;
    Eigen::MatrixXd x(points(), layout_.planes * count);
    const auto of_sample = [&](int64_t i) { return x.middleCols(i * layout_.planes, layout_.planes); };
    for (int64_t i = 0; i < count; ++i) of_sample(i).reshaped() = values_of(r[i], layout_);
    sparse_->solve(x, transposed_);  // its factors are those of A; thomas_ has the rows as they are
    bool finite = true;
    for (int64_t i = 0; i < count; ++i) finite &= store_if_finite<T>(of_sample(i).reshaped(), layout_, d[i]);
    return finite;
  }

 private:
  bool solve_along_axes(const T* r, T* d) const {
    if (!axes_->is_regular()) return false;
    static thread_local std::vector<T> values, field;
    values.resize(layout_.unknowns());
    layout_.store(r, T(1), values.data());
    for (auto at = values.begin(); at != values.end(); at += points()) {
      field.assign(at, at + points());
      axes_->solve(field);
      std::copy(field.begin(), field.end(), at);
    }
    layout_.load(values.data(), T(1), d);
    return std::isfinite(largest_magnitude(values.data(), layout_.unknowns()));
  }
  int64_t points() const { return layout_.rows * layout_.nx; }

  Layout<T> layout_;
  bool transposed_;
  std::optional<CyclicThomas> thomas_;
  std::shared_ptr<const FastDiagonalisation<T>> axes_;
  std::shared_ptr<const SparseFactors> sparse_;
};

/// One pressure is held at zero, and its equation, which the others imply, is left out.
template <class T>
class NavierStokesFactors final : public Factors<T> {
 public:
  explicit NavierStokesFactors(const NavierStokes<T>& kernel)
      : layout_(kernel.layout()),
        transposed_(kernel.transposed()),
        lu_(sparse_factors(kernel, kernel.key(), kernel.transposed(), kernel.unknowns(),
                           pins_of(kernel.null_space(), kernel.left_null_space(), 2 * layout_.rows * layout_.nx))) {}
  bool solve(const T* r, T* d) const override {
    if (!lu_->is_regular()) return false;
    Eigen::VectorXd x = values_of(r, layout_);
    auto pressure = x.tail(layout_.rows * layout_.nx);
    pressure.array() -= pressure.mean();  // of the divergence, which its left null vector forbids
    lu_->solve(x, transposed_);
    pressure.array() -= pressure.mean();  // of the pressure, one of which was held at zero
    return store_if_finite(x, layout_, d);
  }

 private:
  Layout<T> layout_;
  bool transposed_;
  std::shared_ptr<const SparseFactors> lu_;
};

}  // namespace

template <class T>
std::shared_ptr<const Factors<T>> Stencil<T>::factorise() const {
  return std::make_shared<StencilFactors<T>>(*this, source_.key(), source_.transposed);
}
template <class T>
std::shared_ptr<const Factors<T>> NavierStokes<T>::factorise() const {
  return std::make_shared<NavierStokesFactors<T>>(*this);
}

template std::shared_ptr<const Factors<float>> Stencil<float>::factorise() const;
template std::shared_ptr<const Factors<double>> Stencil<double>::factorise() const;
template std::shared_ptr<const Factors<float>> NavierStokes<float>::factorise() const;
template std::shared_ptr<const Factors<double>> NavierStokes<double>::factorise() const;

}  // namespace prdp::kernels
