#include "prdp/operators/upwind_operator.h"

#include "prdp/operators/tensors.h"

namespace prdp {

UpwindOperator::UpwindOperator(const char* owner, const OperatorSpec& spec, int64_t channels)
    : grid_(owner, spec.shape, Boundary::kPeriodic, lengths_of(spec, 1)),
      step_(owner, spec, 2, "two tensors, the winds and nu"),
      winds_(spec.tensors[0]),
      channels_(channels) {}

void UpwindOperator::check_vector(const at::Tensor& b) const {
  grid_.check_field(b, channels_);
  check_goes_with(winds_, b, step_.owner, "the winds");
  step_.check_vector(b);
}

std::vector<int64_t> UpwindOperator::vector_shape() const { return with_channels(channels_, grid_.shape()); }

std::vector<int64_t> UpwindOperator::first_nonfinite(int64_t sample) const {
  return first_true(nonfinite(winds_.select(0, winds_.size(0) == 1 ? 0 : sample)));
}

at::Tensor UpwindOperator::as_winds(std::vector<at::Tensor> channels) const {
  if (winds_.sym_size(1) > static_cast<int64_t>(channels.size()))
    channels.push_back(at::zeros_like(channels[0]));  // a pressure channel blows nowhere
  const auto all = at::cat(channels, 1);
  return winds_.sym_size(0) == 1 ? all.sum(0, /*keepdim=*/true) : all;
}

std::vector<at::Tensor> UpwindOperator::gradients(const UpwindGradients& found) const {
  at::Tensor nu;
  for (const auto& terms : found.nu_terms) add_to(nu, step_.gradient(terms));
  return {found.winds, nu};
}

at::Tensor UpwindOperator::largest(const at::Tensor& row_norms) const {
  const auto norms = row_norms.flatten(1).amax(1);
  return norms.size(0) == 1 ? norms.squeeze(0) : norms;
}

gpu::OperatorView UpwindOperator::upwind_view(const at::Tensor& b, const std::string& name, const std::string& others,
                                              double alpha, double beta) const {
  gpu::OperatorView view{name + "<" + gpu::type_of(b.scalar_type()) + ", " + gpu::grid_of(grid_.shape()) + ", " +
                         others + ">"};
  const auto dim = grid_.dim();
  view.tensors = {(winds_.scalar_type() == b.scalar_type() ? winds_ : winds_.to(b.scalar_type())).contiguous()};
  view.numbers = {alpha, beta, 1.0, dim > 1 ? 1.0 / grid_.dx(0) : 0.0, 1.0 / grid_.dx(dim - 1)};
  const auto& nu = step_.nu;
  if (nu.is_cpu() && !step_.has_axis()) view.numbers[2] = number_of(nu);
  else view.tensors.push_back(nu.detach().to(b.scalar_type()).reshape({-1, 1}));  // nobody waits for it
  return view;
}

}  // namespace prdp
