#pragma once
#include "prdp/gpu/operator_view.h"
#include "prdp/grid/grid.h"
#include "prdp/operators/operator.h"
#include "prdp/operators/step_parameters.h"
#include "prdp/operators/upwind_rule_kernel.h"

namespace prdp {

/// The base of Burgers and Navier-Stokes: one step of a flow on a periodic grid, linearised about given winds.
/// Parameters: dt, and the length per axis if not 1. Tensors: the winds and nu. The winds are (batch, channels,
/// *shape), or (1, channels, *shape) if all samples share them; nu is that of StepParameters. Channel 0 is the velocity
/// along x, the last axis; channel 1 along y.
class UpwindOperator : public Operator {
 public:
  void check_vector(const at::Tensor& b) const override;
  void check_parameters(Checks checks) const override { step_.check_values(checks); }
  std::string refusal(int64_t sample) const override { return step_.refusal(sample); }
  std::vector<int64_t> vector_shape() const override;
  std::vector<int64_t> first_nonfinite(int64_t sample) const override;

 protected:
  /// Vectors have `channels` channels.
  UpwindOperator(const char* owner, const OperatorSpec& spec, int64_t channels);

  /// The kernels that make(parameters) makes of the winds of each sample, kernels::UpwindParameters; Make is a
  /// template.
  template <class Make>
  std::shared_ptr<const kernels::Kernels> upwind_kernels(const at::Tensor& b, bool transposed, const Make& make) const;
  /// What device/upwind.h makes of the winds: `type` is the name of its class with what follows the grid.
  gpu::OperatorView upwind_view(const at::Tensor& b, const std::string& name, const std::string& others, double alpha,
                                double beta) const;
  /// Of the channel that blows along a grid axis: (batch or 1, 1, *shape).
  at::Tensor wind_along(int64_t axis) const { return winds_.narrow(1, grid_.dim() - 1 - axis, 1); }
  /// The gradient of the winds from those of its channels, summed over the samples that share them.
  at::Tensor as_winds(std::vector<at::Tensor> channels) const;
  std::vector<at::Tensor> gradients(const UpwindGradients& found) const;
  /// Largest of the row norms, one per sample, or one value where the winds are shared.
  at::Tensor largest(const at::Tensor& row_norms) const;
  /// Keeps the winds and nu of the samples `index`.
  void take_samples(const at::Tensor& index) {
    if (winds_.size(0) != 1) winds_ = winds_.index_select(0, index);
    step_.nu = step_.nu_of(index);
  }

  Grid grid_;
  StepParameters step_;
  at::Tensor winds_;
  int64_t channels_;
};

}  // namespace prdp
