#include <Eigen/Dense>
#include <cmath>
#include <numbers>

#include "prdp/kernels/axis_products.h"
#include "prdp/kernels/laplacian.h"

namespace prdp::kernels {

namespace {

template <class T>
bool all_finite(const T* x, int64_t n) {
  return std::isfinite(largest_magnitude(x, n));
}

/// Thomas' algorithm for the constant tridiagonal matrix. The one division per row is done beforehand.
template <class T>
class Thomas final : public Factors<T> {
 public:
  Thomas(const LaplacianParameters& p, int64_t n) : off_(static_cast<T>(p.off[0])), inverse_pivot_(n) {
    double pivot = p.centre;
    for (auto& inverse : inverse_pivot_) {
      inverse = static_cast<T>(1.0 / pivot);
      pivot = p.centre - p.off[0] * p.off[0] / pivot;
    }
  }
  bool solve(const T* r, T* d) const override {
    const auto n = static_cast<int64_t>(inverse_pivot_.size());
    T previous = 0;
    for (int64_t i = 0; i < n; ++i) d[i] = previous = (r[i] - off_ * previous) * inverse_pivot_[i];
    for (int64_t i = n - 2; i >= 0; --i) d[i] -= off_ * inverse_pivot_[i] * d[i + 1];
    return all_finite(d, n);
  }

 private:
  T off_;
  std::vector<T> inverse_pivot_;
};

/// Diagonalisation by the sine transform in 2D and 3D: small matrix products along each axis.
template <class T, int Dim>
class SineTransform final : public Factors<T> {
 public:
  SineTransform(const LaplacianParameters& p, const Layout<T>& layout)
      : layout_(layout),
        inverse_(layout.unknowns()),
        basis_({Dim > 2 ? basis(layout.planes) : Matrix(Matrix::Ones(1, 1)), basis(layout.rows), basis(layout.nx)}) {
    int64_t at = 0;
    for (int64_t k = 1; k <= layout.planes; ++k)
      for (int64_t j = 1; j <= layout.rows; ++j)
        for (int64_t i = 1; i <= layout.nx; ++i) {
          // Along one axis, off (v_{i-1} + v_{i+1}) has the eigenvalues 2 off cos(π k / (N + 1)).
          double value =
              p.centre + 2.0 * p.off[Dim - 1] * cosine(i, layout.nx) + 2.0 * p.off[Dim - 2] * cosine(j, layout.rows);
          if constexpr (Dim > 2) value += 2.0 * p.off[0] * cosine(k, layout.planes);
          inverse_[at++] = static_cast<T>(1.0 / value);
        }
  }
  bool solve(const T* r, T* d) const override {
    static thread_local std::vector<T> field, other;
    field.resize(inverse_.size());
    other.resize(inverse_.size());
    layout_.store(r, T(1), field.data());
    basis_.apply(field, other, /*transposed=*/false);
    T* const values = field.data();  // another thread would see a field of its own
    for_each_block_of(layout_.unknowns(), [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) values[i] *= inverse_[i];
    });
    basis_.apply(field, other, /*transposed=*/false);
    layout_.load(field.data(), T(1), d);
    return all_finite(field.data(), static_cast<int64_t>(field.size()));
  }

 private:
  using Matrix = typename AxisProducts<T>::Matrix;

  static double cosine(int64_t k, int64_t n) {
    return std::cos(std::numbers::pi * static_cast<double>(k) / static_cast<double>(n + 1));
  }
  /// S_jk = √(2/(N+1)) sin(π j k/(N+1)), symmetric and its own inverse.
  static Matrix basis(int64_t n) {
    std::vector<double> sine(2 * (n + 1));
    for (int64_t m = 0; m < 2 * (n + 1); ++m)
      sine[m] = std::sqrt(2.0 / static_cast<double>(n + 1)) *
                std::sin(std::numbers::pi * static_cast<double>(m) / static_cast<double>(n + 1));
    Matrix s(n, n);
    for (int64_t j = 0; j < n; ++j)
      for (int64_t k = 0; k < n; ++k) s(j, k) = static_cast<T>(sine[(j + 1) * (k + 1) % (2 * (n + 1))]);
    return s;
  }
  Layout<T> layout_;
  std::vector<T> inverse_;
  AxisProducts<T> basis_;
};

}  // namespace

template <class T, int Dim>
std::shared_ptr<const Factors<T>> Laplacian<T, Dim>::factorise() const {
  if constexpr (Dim == 1) return std::make_shared<Thomas<T>>(parameters_, this->unknowns());
  else return std::make_shared<SineTransform<T, Dim>>(parameters_, layout());
}

template std::shared_ptr<const Factors<float>> Laplacian<float, 1>::factorise() const;
template std::shared_ptr<const Factors<float>> Laplacian<float, 2>::factorise() const;
template std::shared_ptr<const Factors<float>> Laplacian<float, 3>::factorise() const;
template std::shared_ptr<const Factors<double>> Laplacian<double, 1>::factorise() const;
template std::shared_ptr<const Factors<double>> Laplacian<double, 2>::factorise() const;
template std::shared_ptr<const Factors<double>> Laplacian<double, 3>::factorise() const;

}  // namespace prdp::kernels
