#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// A sparse matrix as compressed rows; tensors (crow, col, values), each (…) or (batch, …); only
/// `values` carries a gradient. A derivative with respect to A exists on its pattern alone.
class CsrOperator final : public Operator {
 public:
  /// Checks types and shapes; what the indices say is left to check_parameters(). Values (1, nnz) are those of all
  /// samples, as (nnz,) are.
  explicit CsrOperator(const OperatorSpec& spec);
  void check_vector(const at::Tensor& b) const override;
  /// Raises ValueError unless each crow rises from 0 to nnz and each column lies in [0, n). Torch does not
  /// check this when a sparse tensor is made, and loops and kernels read and write where the indices say.
  void check_parameters(Checks checks) const override;
  at::Tensor apply(const at::Tensor& v) const override;
  at::Tensor apply_transpose(const at::Tensor& v) const override;
  at::Tensor diagonal() const override;
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  at::Tensor norm() const override;
  at::Tensor norm_of_transpose() const override;
  std::vector<int64_t> first_nonfinite(int64_t sample) const override;
  std::unique_ptr<Operator> select(const at::Tensor& index) const override;
  std::vector<int64_t> vector_shape() const override { return {n()}; }
  bool may_be_singular() const override { return true; }
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override;
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override;

 private:
  int64_t n() const { return crow_.size(-1) - 1; }
  /// The row of each stored entry, which is kept: products ask for it again and again.
  at::Tensor rows() const;
  at::Tensor to_dense() const;
  /// The largest sum of magnitudes of the entries that share a row, or a column: which one `of_entries` says.
  at::Tensor largest_sum(const at::Tensor& of_entries) const;
  void drop_axis_of_one();

  at::Tensor crow_, col_, values_;  // (…) or (batch, …)
  bool had_axis_of_one_ = false;           // values were (1, nnz)
  mutable at::Tensor rows_;
};

}  // namespace prdp
