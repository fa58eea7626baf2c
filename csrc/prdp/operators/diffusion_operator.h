#pragma once
#include <array>
#include <string>

#include "prdp/grid/grid.h"
#include "prdp/operators/operator.h"

namespace prdp {

/// What holds at one side of the box: u = 0 on it, half a cell from the nearest centre; no flux through it; the other
/// side follows, for both sides of an axis; or what flows out, -κ ∂u/∂n, is h u.
enum class Side { kZero, kFlux, kPeriodic, kRobin };
/// The sides of an axis, at its low and its high end; one alone is both.
struct Sides {
  Sides(Side both) : Sides(both, both) {}
  Sides(Side low, Side high) : low(low), high(high) {}
  Side low, high;
};
/// How the coefficient on a face is made of those of its two cells.
enum class FaceMean { kHarmonic, kArithmetic };

/// A u = shift·u - ∇·(κ ∇u) on the cells of a box in finite volumes, the same for every channel of u (batch, channel,
/// *shape), for linear_solve. It is symmetric; where nothing holds u, it knows that it is singular.
///
/// kappa: (batch or 1, *shape) with 1 to 3 axes in shape, the values in the centres of the cells, > 0; with `per_axis`
/// (batch or 1, axes, *shape), where ∂(κ_d ∂u/∂x_d)/∂x_d has the κ of its own axis, in the order of shape. shift: a
/// 0-dimensional tensor or (batch or 1, *shape). Both get gradients, which for kappa are formed from differences of u
/// and not from coefficients, so that rounding does not grow with the number of cells. sides: of each axis, or of all:
/// {{Side::kFlux}}, {{Side::kZero, Side::kFlux}, Side::kPeriodic}. lengths: of the box, for each axis or one for all.
/// robin: h >= 0 of each such side in their order, 0-dimensional or (batch or 1, *side), where side is shape without
/// the axis; it gets a gradient. Raises ValueError if these do not fit together.
OperatorSpec diffusion(const at::Tensor& kappa, const at::Tensor& shift,
                       const std::vector<Sides>& sides = {Side::kZero}, const std::vector<double>& lengths = {1.0},
                       FaceMean faces = FaceMean::kHarmonic, const std::vector<at::Tensor>& robin = {},
                       bool per_axis = false);
/// The same with a number as shift.
inline OperatorSpec diffusion(const at::Tensor& kappa, double shift = 0.0,
                              const std::vector<Sides>& sides = {Side::kZero},
                              const std::vector<double>& lengths = {1.0}, FaceMean faces = FaceMean::kHarmonic,
                              const std::vector<at::Tensor>& robin = {}, bool per_axis = false) {
  const auto options = kappa.defined() ? kappa.options().requires_grad(false) : at::TensorOptions();
  return diffusion(kappa, at::full({}, shift, options), sides, lengths, faces, robin, per_axis);
}

/// The operator of kind "diffusion", or "diffusion_per_axis". Parameters: its Box. Tensors: kappa, shift, and h of each
/// Robin side.
class DiffusionOperator final : public Operator {
 public:
  /// What is known of it without a tensor, packed in this order as the parameters of its OperatorSpec.
  struct Box {
    std::vector<std::array<Side, 2>> sides;  // of each axis
    std::vector<double> lengths;
    FaceMean mean = FaceMean::kHarmonic;

    std::vector<double> packed() const;
    static Box unpacked(const std::vector<double>& numbers, size_t axes);
    void check() const;
  };

  explicit DiffusionOperator(const OperatorSpec& spec);

  void check_vector(const at::Tensor& b) const override;
  /// Raises ValueError unless kappa > 0, h >= 0, and a side or the shift holds u where no null space is named.
  void check_parameters(Checks checks) const override;
  std::string refusal(int64_t sample) const override;
  at::Tensor apply(const at::Tensor& v) const override;
  at::Tensor apply_transpose(const at::Tensor& v) const override { return apply(v); }
  at::Tensor diagonal() const override { return coefficients().narrow(1, 0, 1); }
  at::Tensor norm() const override;
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  at::Tensor nonfinite_samples(const at::Tensor& b) const override;
  std::vector<int64_t> first_nonfinite(int64_t sample) const override;
  std::unique_ptr<Operator> select(const at::Tensor& index) const override;
  std::vector<int64_t> vector_shape() const override;
  bool has_coarse_grids() const override { return true; }
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override;
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override;
  std::optional<kernels::FactorKey> key(bool transposed) const override;

  /// The same operator as a stencil.
  OperatorSpec as_stencil() const;

 private:
  std::string remedy_for(const at::Tensor& b) const;
  /// What a side adds to the product rule: to κ of its cells, and h̄. Either may be undefined.
  struct SideProducts {
    at::Tensor of_kappa, of_h;
  };
  SideProducts side_product_rule(int64_t axis, size_t end, const at::Tensor& lambda, const at::Tensor& u) const;
  /// ∂⟨λ, A u⟩/∂κ along an axis, without its sides, added to what is there.
  void add_rule_of_faces(int64_t axis, const at::Tensor& lambda, const at::Tensor& u, at::Tensor& kappa_bar) const;
  /// The same by loops on the CPU, where has_product_rule_loops(), with the sides but for Robin's: a row for each of
  /// SetsOfSamples.
  void add_rule_on_loops(int64_t axis, const at::Tensor& lambda, const at::Tensor& u, at::Tensor& kappa_bar) const;
  template <class T>
  void add_rule_of_axis(int64_t axis, const at::Tensor& lambda, const at::Tensor& u, const at::Tensor& kappa_bar) const;
  /// The product rule in one launch on a GPU; nothing where there is no kernel.
  std::vector<at::Tensor> product_rule_by_kernel(const at::Tensor& lambda, const at::Tensor& u) const;
  template <class T>
  std::vector<at::Tensor> launch_product_rule(const at::Tensor& lambda, const at::Tensor& u) const;
  int64_t dim() const { return static_cast<int64_t>(shape_.size()); }
  /// Whether the first and the last cell of an axis are neighbours; a single cell is none of itself.
  bool wraps_around(int64_t axis) const { return box_.sides[axis][0] == Side::kPeriodic && shape_[axis] > 1; }
  /// Whether the loops make products of differences: in float32, the rounding of a diagonal would change what is slow
  /// to change, the mean of u first, in every solve.
  bool takes_differences() const { return kappa_.scalar_type() == at::kFloat; }
  at::Tensor kappa_along(int64_t axis) const { return per_axis_ ? kappa_.narrow(1, axis, 1) : kappa_; }
  double inverse_width(int64_t axis) const;   // cells per unit of length
  double inverse_width2(int64_t axis) const;  // its square
  /// The first number of a sample that is not finite or not allowed.
  struct Refused {
    const char* must;  // "kappa must be > 0"
    double value;
    std::vector<int64_t> index;
  };
  std::optional<Refused> first_refused(int64_t sample) const;
  /// Samples whose shift and h of every Robin side are zero, while no other side holds u: a tensor (batch or 1). There
  /// A is singular, and as others hold u, no null space is named. Undefined where that cannot be.
  at::Tensor unheld_samples() const;
  /// The shift, with NaN in these samples, which then are refused.
  at::Tensor shift_or_nan() const;
  void check_robin(Checks checks) const;
  void check_held() const;
  void check_kappa(Checks checks) const;
  void check_shapes(const std::vector<at::Tensor>& tensors) const;
  void take_robin(const std::vector<at::Tensor>& tensors, int64_t axis, size_t end);
  const at::Tensor& robin(int64_t axis, size_t end) const;
  std::vector<std::pair<const char*, at::Tensor>> tensors() const;
  /// Coefficients of the faces below and above each cell along an axis, times factor over the squared width; of a side
  /// with u = 0 twice that of its cell, as it is half as far away; of a Robin side that and its h in series.
  std::array<at::Tensor, 2> faces(int64_t axis, double factor = 1.0) const;
  /// Of that stencil: the diagonal, and for each axis what couples a cell to those below and above.
  at::Tensor coefficients() const;

  std::vector<int64_t> shape_;
  Box box_;
  bool per_axis_, names_null_space_;
  mutable bool known_positive_ = false, known_held_ = false;  // once somebody has looked, so that nobody looks again
  // With an axis of one channel, or of those of κ, and one of extent 1 where a side has none; or 0-dimensional.
  at::Tensor kappa_, shift_;
  std::vector<at::Tensor> robin_;  // h of each Robin side, in their order
};

}  // namespace prdp
