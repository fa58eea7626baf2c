#pragma once
#include <ATen/ATen.h>

#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace prdp {

/// An operator as plain numbers and tensors, so that it can pass through torch's dispatcher.
struct OperatorSpec {
  std::string kind;                  // "heat", "poisson", "burgers", "navier_stokes", "stencil", "dense", "csr", …
  std::vector<int64_t> shape;        // of the grid of unknowns; empty for matrices
  std::vector<double> parameters;    // plain numbers without gradient, such as dt and the lengths
  std::vector<at::Tensor> tensors;   // what A depends on and may get gradients, such as nu
  bool transposed = false;
};

namespace kernels {
struct FactorKey;
struct Kernels;
}  // namespace kernels
namespace gpu {
struct OperatorView;
}

/// Which numbers Operator::check_parameters() looks at. The others are left to the solve, where what is not allowed
/// counts as not finite.
enum class Checks {
  kAll,
  kShared,  // not what a sample has for itself: it fails alone
  kHost,    // not what lies on a GPU, so that the host need not wait for it
};

/// A linear operator A(g) on batches of vectors: (batch, channel, *shape) on grids, (batch, n) for matrices. It is
/// immutable.
class Operator {
 public:
  virtual ~Operator() = default;

  // ---- what it may be given. Each raises ValueError or TypeError

  /// Unless b is a right-hand side of this operator.
  virtual void check_vector(const at::Tensor& b) const = 0;
  /// If the value of a parameter is not allowed, such as a negative nu.
  virtual void check_parameters(Checks /*checks*/ = Checks::kAll) const {}
  /// If what somebody named as a null space is none, for vectors like b.
  virtual void check_null_spaces(const at::Tensor& /*b*/) const {}

  // ---- A in tensor operations

  /// A v and Aᵀ v, differentiable in v and in the tensors of A.
  virtual at::Tensor apply(const at::Tensor& v) const = 0;
  virtual at::Tensor apply_transpose(const at::Tensor& v) const = 0;
  /// The diagonal of A, in a shape that broadcasts against a batch of vectors.
  virtual at::Tensor diagonal() const = 0;
  /// ∂⟨λ, A(g) u⟩/∂g, one per tensor of A; undefined for tensors without a derivative. Differentiable.
  virtual std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const = 0;
  /// A⁻¹ b, or A⁻ᵀ b, by the cheapest exact method; differentiable.
  virtual at::Tensor solve_directly(const at::Tensor& b, bool transposed) const = 0;
  /// ‖A‖∞, or a little more: one value, or one per sample. 0 where it is not known, as of a Function; not finite where
  /// A is not.
  virtual at::Tensor norm() const = 0;
  /// ‖Aᵀ‖∞ in the same way.
  virtual at::Tensor norm_of_transpose() const { return norm(); }  // of a symmetric A, or where it is not known
  /// ρ, the spectral radius of I - D⁻¹A, whose eigenvalues come in pairs ±μ. Differentiable in the tensors of A. Raises
  /// ValueError if it is not known.
  virtual at::Tensor jacobi_radius() const;
  virtual bool knows_jacobi_radius() const { return false; }

  // ---- null spaces

  /// v projected onto the range of A, and v without its part in the null space of A. Both return v if A is regular.
  /// Differentiable.
  virtual at::Tensor project(const at::Tensor& v) const { return v; }
  virtual at::Tensor project_solution(const at::Tensor& v) const { return project(v); }
  /// Whether vectors must be projected again in every iteration, because A maps its declared null space to zero only up
  /// to rounding.
  virtual bool needs_projection() const { return false; }
  /// Whether its entries or functions are the user's own: it may be singular though nobody declared a null space. Then
  /// apply_transpose() must work without autograd.
  virtual bool may_be_singular() const { return false; }

  // ---- its samples

  /// The shape of one vector without its batch axis; with one channel if A takes any number of them.
  virtual std::vector<int64_t> vector_shape() const = 0;
  /// The operator for the samples `index` (int64) alone, differentiable in the same tensors; null if that is not
  /// possible.
  virtual std::unique_ptr<Operator> select(const at::Tensor& index) const = 0;
  /// Which samples of b have an A that holds a NaN or Inf: (batch,), or one for all.
  virtual at::Tensor nonfinite_samples(const at::Tensor& /*b*/) const { return norm().isfinite().logical_not(); }
  /// The index of the first NaN or Inf in the tensors of A, or of what counts as one: (i, j) in a matrix, (channel,
  /// *grid) in winds. Empty where an index would say nothing.
  virtual std::vector<int64_t> first_nonfinite(int64_t /*sample*/) const { return {}; }
  /// Why the parameters of a sample are refused though they are finite, and a remedy: "kappa must be > 0, got -1; …".
  /// Or empty.
  virtual std::string refusal(int64_t /*sample*/) const { return {}; }

  // ---- A in other forms

  /// A, or Aᵀ, for the CPU loops on vectors with the shape and dtype of b; null if there are no such loops.
  virtual std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const;
  /// A, or Aᵀ, for the kernels of a GPU, on vectors like b; nothing if there are none.
  virtual std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const;
  /// Whether multigrid can make coarse grids of it: a stencil whose neighbours lie at most one cell away.
  virtual bool has_coarse_grids() const { return false; }
  /// Whether there is a preconditioner made of V-cycles.
  virtual bool has_multigrid_preconditioner() const { return has_coarse_grids(); }
  /// Tells factors that all samples share from those of other operators; nothing if they do not share them, or if to
  /// make them takes no longer than to read the numbers of A.
  virtual std::optional<kernels::FactorKey> key(bool transposed) const;
  /// A as a matrix (n, n), or (batch, n, n) if A differs between samples.
  at::Tensor dense(const at::TensorOptions& options) const;
};

/// The index of the first true entry, and a mask of the entries that are NaN or Inf.
std::vector<int64_t> first_true(const at::Tensor& mask);
at::Tensor nonfinite(const at::Tensor& t);

/// Builds the operator that `spec` describes. Raises ValueError for an unknown kind or bad shapes.
std::unique_ptr<Operator> make_operator(const OperatorSpec& spec);

}  // namespace prdp
