#include "prdp/operators/laplacian_operator.h"

#include <ATen/core/grad_mode.h>

#include <cmath>

#include "prdp/gpu/operator_view.h"
#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/laplacian.h"
#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/broadcast_sums.h"
#include "prdp/operators/cyclic_reduction.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/product_rule_kernels.h"
#include "prdp/operators/separable_inverse.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"

namespace prdp {

at::Tensor LaplacianOperator::diagonal() const {
  return symbol(at::scalar_tensor(laplacian_diagonal(grid_), at::kDouble));
}

namespace {

/// The sine bases of all axes and the eigenvalues of L, on a device.
struct SineAxes {
  std::vector<at::Tensor> bases;
  at::Tensor eigenvalues;

  SineAxes(const Grid& grid, const at::TensorOptions& real)
      : eigenvalues(laplacian_eigenvalues(grid, at::kDouble).to(real)) {
    for (const int64_t n : grid.shape()) bases.push_back(sine_basis(n, at::kDouble).to(real));
  }
  int64_t bytes() const {
    auto sum = static_cast<int64_t>(eigenvalues.nbytes());
    for (const auto& basis : bases) sum += static_cast<int64_t>(basis.nbytes());
    return sum;
  }
  static std::shared_ptr<const SineAxes> find_or_make(const Grid& grid, const at::TensorOptions& real) {
    kernels::FactorKeyMaker key;
    for (int64_t d = 0; d < grid.dim(); ++d) key.add(grid.shape()[d]).add(grid.dx(d));
    key.add(static_cast<int64_t>(real.device().type())).add(int64_t{real.device().index()});
    return factor_cache::find_or_make<SineAxes>(key.key(), [&] { return std::make_shared<SineAxes>(grid, real); });
  }
};

}  // namespace

at::Tensor LaplacianOperator::solve_on_device(const at::Tensor& b) const {
  const auto real = b.options().dtype(widest_real(b.device()));
  constexpr int64_t longest_alone = 4096;  // a longer basis takes more memory than the vectors of a large batch
  if (grid_.dim() == 1 && grid_.shape()[0] > longest_alone) {
    const double inverse_width2 = 1.0 / (grid_.dx(0) * grid_.dx(0));
    const auto of = [&](double x) { return symbol(at::full({1}, x, real)).reshape({-1, 1}).to(real); };
    const auto beside = (of(inverse_width2) - of(0.0)).expand({-1, grid_.shape()[0] - 1});
    const auto coefficients = at::stack({of(-2.0 * inverse_width2).expand({-1, grid_.shape()[0]}),
                                         at::constant_pad_nd(beside, {1, 0}), at::constant_pad_nd(beside, {0, 1})},
                                        1);
    return CyclicReduction(coefficients, 0.0).solve(b.to(real)).to(b.scalar_type());
  }
  const auto axes = SineAxes::find_or_make(grid_, real);
  const auto waves = along_axes(b, axes->bases, /*transposed=*/false) / symbol(axes->eigenvalues);
  return along_axes(waves, axes->bases, /*transposed=*/false).to(b.scalar_type());
}

at::Tensor LaplacianOperator::solve_directly(const at::Tensor& b, bool /*transposed*/) const {
  if (!b.is_cpu()) return solve_on_device(b);
  const auto eigenvalues = symbol(laplacian_eigenvalues(grid_, b.options()));
  return sine_transform(sine_transform(b, grid_) / eigenvalues.to(b.scalar_type()), grid_);
}

at::Tensor LaplacianOperator::norm() const {
  const double centre = laplacian_diagonal(grid_);
  std::vector<double> norms;
  for (const auto& [alpha, beta] : coefficients())
    norms.push_back(std::abs(alpha + beta * centre) + std::abs(beta * centre));
  const auto all = at::tensor(norms, at::kDouble);
  return norms.size() == 1 ? all.squeeze(0) : all;
}

at::Tensor LaplacianOperator::jacobi_radius() const {
  const auto slowest = laplacian_eigenvalues(grid_, at::TensorOptions().dtype(at::kDouble)).amax();
  return 1.0 - symbol(slowest) / diagonal();
}

std::vector<int64_t> LaplacianOperator::vector_shape() const { return with_channels(1, grid_.shape()); }

std::shared_ptr<const kernels::Kernels> LaplacianOperator::kernels(const at::Tensor& b, bool) const {
  std::vector<kernels::LaplacianParameters> of_samples;
  for (const auto& [alpha, beta] : coefficients()) {
    kernels::LaplacianParameters k;
    k.dim = grid_.dim();
    k.centre = alpha + beta * laplacian_diagonal(grid_);
    for (int64_t d = 0; d < k.dim; ++d) {
      k.shape[d] = grid_.shape()[d];
      k.off[d] = beta / (grid_.dx(d) * grid_.dx(d));
    }
    of_samples.push_back(k);
  }
  return kernels::make_kernels(b.scalar_type() == at::kFloat,
                               [&]<class T>(T) { return kernels::laplacian<T>(std::move(of_samples)); });
}

std::optional<gpu::OperatorView> LaplacianOperator::gpu_view(const at::Tensor& b, bool) const {
  const auto [alpha, beta, nu] = factors();
  const auto dim = grid_.dim();
  gpu::OperatorView view{"Laplacian<" + gpu::type_of(b.scalar_type()) + ", " + gpu::grid_of(grid_.shape()) + ">"};
  view.numbers = {alpha, beta, 0.0, 0.0, 0.0};  // 1/h² along z, y and x
  for (int64_t d = 0; d < dim; ++d) view.numbers[5 - dim + d] = 1.0 / (grid_.dx(d) * grid_.dx(d));
  if (!nu.defined()) return view;
  if (nu.is_cpu() && nu.dim() == 0) view.numbers[1] *= number_of(nu);
  else view.tensors = {nu.detach().to(b.scalar_type()).reshape({-1, 1})};  // nobody waits for it
  return view;
}

PoissonOperator::PoissonOperator(const OperatorSpec& spec)
    : LaplacianOperator(Grid("Poisson", spec.shape, Boundary::kDirichlet, lengths_of(spec, 0))) {
  TORCH_CHECK_VALUE(spec.tensors.empty(), "Poisson: takes no tensors");
}

HeatOperator::HeatOperator(const OperatorSpec& spec)
    : LaplacianOperator(Grid("Heat", spec.shape, Boundary::kDirichlet, lengths_of(spec, 1))),
      step_("Heat", spec, 1, "one tensor, nu") {}

void HeatOperator::check_vector(const at::Tensor& b) const {
  LaplacianOperator::check_vector(b);
  step_.check_vector(b);
}

at::Tensor HeatOperator::apply(const at::Tensor& v) const { return v - diffusion() * laplacian(v, grid_); }

std::vector<LaplacianOperator::Coefficients> HeatOperator::coefficients() const {
  std::vector<Coefficients> of_samples;
  for (const double nu : step_.nu_values()) of_samples.push_back({1.0, -nu * step_.dt});
  return of_samples;
}

std::unique_ptr<Operator> HeatOperator::select(const at::Tensor& index) const {
  auto chosen = std::make_unique<HeatOperator>(*this);
  chosen->step_.nu = step_.nu_of(index);
  return chosen;
}

namespace {

/// ⟨λ, L u⟩ in one launch; undefined where there is no kernel.
template <class T>
at::Tensor product_with_laplacian(const at::Tensor& lambda, const at::Tensor& u, const Grid& grid,
                                  const at::Tensor& nu) {
  BroadcastSums sums(lambda);
  gpu::LaplacianProductRule<T> of{pair_of<T>(lambda, u, /*sets=*/1), {1, 1, 1}, {}, sums.add(nu), nullptr};
  of.out = sums.memory(0);
  for (int64_t d = 0; d < grid.dim(); ++d) {
    const int64_t axis = d + 3 - grid.dim();
    of.n[axis] = static_cast<int>(grid.shape()[d]);
    of.inverse_width2[axis] = 1.0 / (grid.dx(d) * grid.dx(d));
  }
  return gpu::each_point(u.device(), product_rule_body<T>("LaplacianProductRule"), of, sums.count()) ? sums.result(0)
                                                                                                     : at::Tensor();
}

}  // namespace

std::vector<at::Tensor> HeatOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  // ∂⟨λ, u - ν Δt L u⟩/∂ν = -Δt ⟨λ, L u⟩
  if (has_product_rule_kernel(lambda, u)) {
    const auto by_kernel =
        u.scalar_type() == at::kFloat ? product_with_laplacian<float> : product_with_laplacian<double>;
    const auto product = by_kernel(lambda.contiguous(), u.contiguous(), grid_, step_.nu_beside(grid_.dim()));
    if (product.defined()) return {(product * -step_.dt).reshape(step_.nu.sizes()).to(step_.nu.options())};
  }
  const bool by_loops = !at::GradMode::is_enabled() && is_plain(u) && is_plain(lambda) && !has_tangent(u);
  const auto lu = by_loops ? apply_on_loops(PoissonOperator(grid_), u, /*transposed=*/false) : laplacian(u, grid_);
  return {step_.gradient(lambda * lu) * -step_.dt};
}

}  // namespace prdp
