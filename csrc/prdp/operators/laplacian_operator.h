#pragma once
#include "prdp/grid/grid.h"
#include "prdp/operators/operator.h"
#include "prdp/operators/step_parameters.h"

namespace prdp {

/// What Poisson and heat share: A = α I + β L with the Dirichlet Laplacian L, symmetric.
class LaplacianOperator : public Operator {
 public:
  void check_vector(const at::Tensor& b) const override { grid_.check_field(b, 1); }
  at::Tensor apply_transpose(const at::Tensor& v) const override { return apply(v); }
  at::Tensor diagonal() const override;
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  at::Tensor norm() const override;
  at::Tensor jacobi_radius() const override;
  bool knows_jacobi_radius() const override { return true; }
  bool has_coarse_grids() const override { return true; }
  std::vector<int64_t> vector_shape() const override;
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override;
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override;

 protected:
  explicit LaplacianOperator(Grid grid) : grid_(std::move(grid)) {}

  /// α and β as numbers, for the CPU loops: one pair, or one for each sample.
  struct Coefficients {
    double alpha, beta;
  };
  virtual std::vector<Coefficients> coefficients() const = 0;
  /// The same with β as a number times nu; without nu, the number alone.
  struct Factors {
    double alpha, beta;
    at::Tensor nu{};
  };
  virtual Factors factors() const = 0;
  /// α + β x for a tensor x in L's place, a number or (*shape) (its diagonal, its eigenvalues), beside vectors;
  /// differentiable.
  virtual at::Tensor symbol(const at::Tensor& x) const = 0;

  Grid grid_;

 private:
  /// The exact solve without loops: sine transforms, and cyclic reduction on a long line.
  at::Tensor solve_on_device(const at::Tensor& b) const;
};

/// The Laplacian itself, A = L (negative definite).
class PoissonOperator final : public LaplacianOperator {
 public:
  explicit PoissonOperator(const OperatorSpec& spec);
  explicit PoissonOperator(Grid grid) : LaplacianOperator(std::move(grid)) {}
  at::Tensor apply(const at::Tensor& v) const override { return laplacian(v, grid_); }
  std::unique_ptr<Operator> select(const at::Tensor&) const override {
    return std::make_unique<PoissonOperator>(*this);
  }
  std::vector<at::Tensor> product_rule(const at::Tensor&, const at::Tensor&) const override { return {}; }

 private:
  std::vector<Coefficients> coefficients() const override { return {{0.0, 1.0}}; }
  Factors factors() const override { return {0.0, 1.0}; }
  at::Tensor symbol(const at::Tensor& x) const override { return x; }
};

/// One implicit Euler step of the heat equation, A = I - ν Δt L; parameters (dt, length per axis if not
/// 1), tensors (nu), as in StepParameters.
class HeatOperator final : public LaplacianOperator {
 public:
  explicit HeatOperator(const OperatorSpec& spec);
  void check_parameters(Checks checks) const override { step_.check_values(checks); }
  at::Tensor apply(const at::Tensor& v) const override;
  void check_vector(const at::Tensor& b) const override;
  std::string refusal(int64_t sample) const override { return step_.refusal(sample); }
  std::unique_ptr<Operator> select(const at::Tensor& index) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;

 private:
  std::vector<Coefficients> coefficients() const override;
  Factors factors() const override { return {1.0, -step_.dt, step_.nu}; }
  at::Tensor symbol(const at::Tensor& x) const override { return 1.0 - diffusion() * x; }
  /// ν Δt, beside vectors.
  at::Tensor diffusion() const { return step_.nu_beside(grid_.dim()) * step_.dt; }

  StepParameters step_;
};

}  // namespace prdp
