#pragma once
#include <c10/util/Exception.h>

#include <array>
#include <functional>
#include <memory>
#include <optional>
#include <variant>

#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/layout.h"
#include "prdp/kernels/null_space.h"
#include "prdp/kernels/stencil_fields.h"

namespace prdp::kernels {

/// The exact method of an operator, made once and used for any number of right-hand sides, by any thread.
template <class T>
class Factors {
 public:
  virtual ~Factors() = default;
  /// d = A⁻¹ r in padded memory; false if A is singular.
  virtual bool solve(const T* r, T* d) const = 0;
  /// Whether several right-hand sides together take less time than one after the other; and that, with the same bits
  /// for each as alone.
  virtual bool gains_by_several() const { return false; }
  virtual bool solve_several(const T* const* r, T* const* d, int64_t count) const {
    bool found = true;
    for (int64_t i = 0; i < count; ++i) found &= solve(r[i], d[i]);
    return found;
  }
  /// Whether A x is at hand, as x is a solution that was found among several; if so, stores it.
  virtual bool has_product(const T* /*x*/, T* /*out*/) const { return false; }
};

/// factor()·A on one channel of one sample, as a stencil on a grid.
template <class T>
struct GridOperator {
  std::function<std::optional<StencilFields<T>>()> make;  // not transposed; nothing if neighbours lie far away
  FactorKey key;  // under which its factors and coarse grids are kept (factor_cache.h)
  bool transposed;
};

template <class T>
class Preconditioner;

/// Where the rows of a matrix differ by more, its factors in float64 lose what couples the small ones.
inline constexpr double kWidestRowsOfFactors = 1e13;

/// A on one sample in padded memory: everything that the CPU loops know of an operator. It may be used by several
/// threads at once. What it computes with is factor()·A, where the factor is a power of two: entries far from the
/// order of one are scaled, so that products of several of them neither overflow nor underflow.
template <class T>
class Kernel {
 public:
  Kernel(const Layout<T>& layout, T factor) : layout_(layout), factor_(factor) {}
  Kernel(const Kernel&) = delete;
  Kernel& operator=(const Kernel&) = delete;
  virtual ~Kernel() = default;

  const Layout<T>& layout() const { return layout_; }
  int64_t unknowns() const { return layout_.unknowns(); }
  int64_t length() const { return layout_.length(); }
  T factor() const { return factor_; }

  /// ‖A‖∞
  virtual double norm() const = 0;
  /// Whether A is known to be positive definite, and rounding does not change that.
  virtual bool is_surely_definite() const { return false; }
  /// Whether its factors in float64 are, too, which x was made by: not where its rows differ by kWidestRowsOfFactors,
  /// nor where the factors have lost what holds the constant.
  virtual bool has_definite_factors(const T* /*x*/, const T* /*b*/) const { return false; }
  /// Multiplications of a product.
  virtual int64_t work() const { return unknowns(); }
  /// out = A v
  virtual void apply(const T* v, T* out) const = 0;
  /// The same for several vectors, with the bits that each has alone; false if that takes as long as one after the
  /// other.
  virtual bool apply_to_several(const T* const* /*v*/, T* const* /*out*/, int64_t /*count*/) const { return false; }
  /// As apply(); returns v·out and ‖out‖².
  virtual std::array<T, 2> apply_with_dots(const T* v, T* out) const {
    apply(v, out);
    return {vectors_.dot(v, out, length()), vectors_.dot(out, out, length())};
  }

  virtual bool has_zero_diagonal() const = 0;
  /// c = D⁻¹ b
  virtual void divide_by_diagonal(const T* b, T* c) const = 0;
  /// n Jacobi sweeps x ← x + D⁻¹(b - A x) with c = D⁻¹ b; y is memory that they use. With omega, one for each sweep,
  /// Chebyshev's x ← y + omega (that - y): y holds the iterate before x, on entry and on return; only where the
  /// spectral radius is known.
  virtual void jacobi_sweeps(const T* c, T*& x, T*& y, int64_t n, const T* omega) const = 0;
  /// One of them, from x to y; returns ‖b - A x‖².
  virtual T jacobi_sweep(const T* c, const T* x, T* y, const T* omega) const = 0;
  /// The spectral radius of I - D⁻¹A, which is symmetric there; nothing if it is not known.
  virtual std::optional<double> radius() const { return std::nullopt; }

  /// A smoothing step, y = x + p (x - y) + q D⁻¹(b - A x): on entry y is the iterate before x, on return the one after
  /// it. Only for a grid_operator(), as residual().
  virtual void smooth(const T* b, const T* x, T* y, T p, T q) const;
  /// r = b - A x
  virtual void residual(const T* b, const T* x, T* r) const;
  /// What multigrid makes its coarse grids of; nothing if the operator is not of that kind.
  virtual std::optional<GridOperator<T>> grid_operator() const { return std::nullopt; }

  /// M⁻¹ made of V-cycles; null if the operator has no coarse grids, or these no inverse diagonal. M⁻ᵀ needs
  /// `transpose`, the kernel of Aᵀ, where A is not symmetric.
  virtual std::unique_ptr<Preconditioner<T>> multigrid(const Kernel* transpose, int64_t smoothing) const;

  virtual std::shared_ptr<const Factors<T>> factorise() const = 0;

  /// From here on it refers to no memory that it was made of. It has no grid_operator() then.
  virtual void leave_source() {}
  /// Bytes that it holds, about: here of one vector and of the null spaces, to which others add their coefficients.
  virtual int64_t bytes() const {
    const int64_t vectors =
        1 + (null_space_ ? null_space_->count_in_one_field() + left_null_space_->count_in_one_field() : 0);
    return vectors * length() * static_cast<int64_t>(sizeof(T));
  }

  /// The null space of A, if it was named: what A maps to zero, and what no product with A contains.
  const std::optional<NullSpace<T>>& null_space() const { return null_space_; }
  const std::optional<NullSpace<T>>& left_null_space() const { return left_null_space_; }
  void set_null_spaces(NullSpace<T> right, NullSpace<T> left) {
    null_space_.emplace(std::move(right));
    left_null_space_.emplace(std::move(left));
  }
  /// Whether A maps a null space that somebody named to zero up to rounding only. Then products are to be projected:
  /// what is left there would add up in the residuals that a method carries on.
  bool needs_projection() const { return needs_projection_; }
  void set_needs_projection() { needs_projection_ = true; }

 protected:
  const WholeVectors<T> vectors_{};

 private:
  Layout<T> layout_;
  T factor_;
  std::optional<NullSpace<T>> null_space_, left_null_space_;
  bool needs_projection_ = false;
};

template <class T>
void Kernel<T>::smooth(const T*, const T*, T*, T, T) const {
  TORCH_INTERNAL_ASSERT(false, "no multigrid for this operator");
}
template <class T>
void Kernel<T>::residual(const T*, const T*, T*) const {
  TORCH_INTERNAL_ASSERT(false, "no multigrid for this operator");
}

/// A of a batch: one kernel for all samples, or one for each.
template <class T>
struct KernelBatch {
  bool is_shared;
  /// Null where A is not finite. The kernel may refer to the memory that the batch was made of.
  std::function<std::unique_ptr<Kernel<T>>(int64_t sample)> make;
  /// out = A v of one sample, both contiguous, for whoever needs a single product: nothing is made first, so nothing is
  /// scaled. Empty where that saves nothing.
  std::function<void(int64_t sample, const T* v, T* out)> product = nullptr;
};

/// The same in the dtype of the vectors.
struct Kernels {
  std::variant<KernelBatch<float>, KernelBatch<double>> of_dtype;
};

/// Of make(T()), a KernelBatch<T>.
template <class Make>
std::shared_ptr<const Kernels> make_kernels(bool single, const Make& make) {
  if (single) return std::make_shared<Kernels>(Kernels{make(float())});
  return std::make_shared<Kernels>(Kernels{make(double())});
}

}  // namespace prdp::kernels
