#pragma once
#include <ATen/ATen.h>

#include <array>
#include <memory>
#include <string>
#include <variant>
#include <vector>

#include "prdp/kernels/laplacian_parameters.h"

namespace prdp {

/// The flat description of an operator, as it crosses torch's dispatcher: numbers and tensors only.
struct OperatorSpec {
  std::string kind;                  // "heat", "poisson", "burgers", "navier_stokes", "dense", "csr"
  std::vector<int64_t> shape;        // grid of unknowns; empty for matrices
  std::vector<double> parameters;    // plain numbers without gradient, such as dt and the lengths
  std::vector<at::Tensor> tensors;   // what A depends on and is differentiated for, such as nu
  bool transposed = false;
};

/// A contiguous matrix (n, n) shared by all samples, or (batch, n, n).
struct DenseParameters {
  at::Tensor matrix;
  bool transposed = false;
};

/// Compressed sparse rows with int64 indices: crow (n + 1), col and values (nnz), contiguous; or
/// each with a leading batch axis.
struct CsrParameters {
  at::Tensor crow, col, values;
  bool transposed = false;
};

/// The winds (batch or 1, Dim, *shape), contiguous, of I + dt Γ - ν dt L on a periodic grid in one or
/// two dimensions; channel 0 is the velocity along x, the last axis.
struct BurgersParameters {
  at::Tensor winds;
  double nu, dt;
  bool transposed = false;
  std::array<double, 2> length{1.0, 1.0};  // of the domain, along y and x
};

/// The velocity (batch or 1, 2 or more, Ny, Nx), contiguous, about which the Navier–Stokes equations
/// are linearised on a periodic staggered grid; the first two channels are u1 (along x) and u2.
struct NavierStokesParameters {
  at::Tensor velocity;
  double nu, dt;
  bool transposed = false;
  std::array<double, 2> length{1.0, 1.0};  // of the domain, along y and x
};

/// What the CPU loops need to know of an operator; monostate: it has plain tensor operations only.
using KernelParameters = std::variant<std::monostate, kernels::LaplacianParameters, DenseParameters,
                                      CsrParameters, BurgersParameters, NavierStokesParameters>;

/// A linear operator A(g) on batches of fields. Immutable; knows nothing of solvers.
/// Vectors are batched: (batch, channel, *shape) for stencils, (batch, n) for matrices.
class Operator {
 public:
  virtual ~Operator() = default;

  /// Raises ValueError or TypeError unless b is a right-hand side of this operator.
  virtual void check_vector(const at::Tensor& b) const = 0;
  /// Raises ValueError where a parameter is not allowed by its value (a negative nu).
  virtual void check_parameters() const {}

  /// A v and Aᵀ v, differentiable in v and in the tensors of A.
  virtual at::Tensor apply(const at::Tensor& v) const = 0;
  virtual at::Tensor apply_transpose(const at::Tensor& v) const = 0;
  /// Diagonal of A, broadcastable against a batch of vectors.
  virtual at::Tensor diagonal() const = 0;
  /// A⁻¹ b and A⁻ᵀ b by the cheapest exact method that plain tensors allow; differentiable.
  virtual at::Tensor solve_directly(const at::Tensor& b) const = 0;
  virtual at::Tensor solve_transpose_directly(const at::Tensor& b) const = 0;
  /// ∂⟨λ, A(g) u⟩/∂g, one per tensor of A; undefined where there is no derivative. Differentiable.
  virtual std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const = 0;
  /// ‖A‖∞, one value or one per sample.
  virtual at::Tensor norm() const = 0;
  /// v without its part in the null space of A and Aᵀ; v itself where A is regular. Differentiable.
  virtual at::Tensor project(const at::Tensor& v) const { return v; }
  /// M⁻¹ v and M⁻ᵀ v for a cheap M ≈ A that suits this operator; ValueError where there is none.
  virtual at::Tensor precondition(const at::Tensor& v, bool transposed) const;
  /// ρ, the spectral radius of I - D⁻¹A, whose eigenvalues come in pairs ±μ; differentiable in the tensors of
  /// A. ValueError where it is not known.
  virtual at::Tensor jacobi_radius() const;
  /// Where the first NaN or Inf that A is made of sits: (i, j) in a matrix, (channel, *grid) in winds.
  virtual std::vector<int64_t> first_nonfinite(int64_t /*sample*/) const { return {}; }
  /// The operator of the samples `index` (int64) alone, differentiable in the same tensors; null where
  /// that is not known.
  virtual std::unique_ptr<Operator> select(const at::Tensor& index) const = 0;
  /// Shape of one vector without its batch axis.
  virtual std::vector<int64_t> vector_shape() const = 0;

  virtual KernelParameters kernel() const { return std::monostate{}; }

  /// A as a matrix (n, n), or (batch, n, n) where A differs between the samples.
  at::Tensor dense(const at::TensorOptions& options) const;
};

/// Index of the first true entry; which entries are NaN or Inf.
std::vector<int64_t> first_true(const at::Tensor& mask);
at::Tensor nonfinite(const at::Tensor& t);

/// Builds the operator that `spec` describes. Raises ValueError for an unknown kind or bad shapes.
std::unique_ptr<Operator> make_operator(const OperatorSpec& spec);

}  // namespace prdp
