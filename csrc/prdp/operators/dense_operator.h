#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// A matrix given by the user as a tensor (n, n) shared by the batch, or (batch, n, n).
class DenseOperator final : public Operator {
 public:
  /// A matrix (1, n, n) is that of all samples, as (n, n) is.
  explicit DenseOperator(const OperatorSpec& spec);
  void check_vector(const at::Tensor& b) const override;
  at::Tensor apply(const at::Tensor& v) const override;
  at::Tensor apply_transpose(const at::Tensor& v) const override;
  at::Tensor diagonal() const override;
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  at::Tensor norm() const override;
  at::Tensor norm_of_transpose() const override;
  std::vector<int64_t> first_nonfinite(int64_t sample) const override;
  std::unique_ptr<Operator> select(const at::Tensor& index) const override;
  std::vector<int64_t> vector_shape() const override { return {matrix_.size(-1)}; }
  bool may_be_singular() const override { return true; }
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override;
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override;

 private:
  void drop_axis_of_one();

  at::Tensor matrix_;        // (n, n) or (batch, n, n)
  bool had_axis_of_one_ = false;    // it was (1, n, n)
};

}  // namespace prdp
