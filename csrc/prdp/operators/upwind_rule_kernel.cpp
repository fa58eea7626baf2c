#include "prdp/operators/upwind_rule_kernel.h"

#include <ATen/Dispatch.h>

#include "prdp/gpu/device/upwind_product_rule.h"
#include "prdp/operators/product_rule_kernels.h"

namespace prdp {

namespace {

constexpr const char* kHeader = "prdp/gpu/device/upwind_product_rule.h";

template <class T>
gpu::PeriodicGrid<T> device_grid(const Grid& grid) {
  gpu::PeriodicGrid<T> made{{1, 1}, {T(0), T(0)}};
  for (int64_t axis = 0; axis < grid.dim(); ++axis) {
    const auto place = static_cast<size_t>(grid.dim() - 1 - axis);  // x first
    made.n[place] = static_cast<int>(grid.shape()[axis]);
    made.per_dx[place] = static_cast<T>(1.0 / grid.dx(axis));
  }
  return made;
}

/// `of_winds(pair, device grid, winds, out)` launches the kernel of the winds. `channels`: that ν acts on.
template <class T, class OfWinds>
std::optional<UpwindGradients> products(const Grid& grid, const at::Tensor& winds, double beta, int64_t channels,
                                        const at::Tensor& lambda, const at::Tensor& u, const OfWinds& of_winds) {
  const auto given = winds.detach().contiguous(), l = lambda.contiguous(), v = u.contiguous();
  const auto out = at::empty_like(given);
  const int64_t batch = l.size(0);
  const auto on_device = device_grid<T>(grid);
  if (!of_winds(pair_of<T>(l, v, out.size(0)), on_device, given.const_data_ptr<T>(), out)) return std::nullopt;
  const auto sums = at::empty({batch}, out.options().dtype(at::kDouble));
  const gpu::ViscosityProductRule<T> of{pair_of<T>(l, v, /*sets=*/batch),
                                        on_device,
                                        static_cast<T>(beta),
                                        static_cast<int>(grid.dim()),
                                        static_cast<int>(channels),
                                        sums.mutable_data_ptr<double>()};
  if (!gpu::each_sample(out.device(), product_rule_body<T>("ViscosityProductRule", kHeader), of,
                        channels * of.pair.points, batch))
    return std::nullopt;
  return UpwindGradients{out, {sums}};
}

}  // namespace

std::optional<UpwindGradients> burgers_rule_by_kernel(const Grid& grid, const at::Tensor& winds, double beta,
                                                      const at::Tensor& lambda, const at::Tensor& u) {
  if (!has_product_rule_kernel(lambda, u)) return std::nullopt;
  return AT_DISPATCH_FLOATING_TYPES(u.scalar_type(), "burgers_rule_by_kernel", [&] {
    using T = scalar_t;
    return products<T>(
        grid, winds, beta, u.size(1), lambda, u,
        [&](const auto& pair, const auto& on_device, const T* given, const at::Tensor& out) {
          const gpu::BurgersProductRule<T> of{
              pair, on_device, static_cast<T>(beta), static_cast<int>(grid.dim()), given, out.mutable_data_ptr<T>()};
          return gpu::each_point(out.device(), product_rule_body<T>("BurgersProductRule", kHeader), of, out.numel());
        });
  });
}

std::optional<UpwindGradients> navier_stokes_rule_by_kernel(const Grid& grid, const at::Tensor& winds,
                                                            const at::Tensor& lambda, const at::Tensor& u) {
  if (!has_product_rule_kernel(lambda, u)) return std::nullopt;
  return AT_DISPATCH_FLOATING_TYPES(u.scalar_type(), "navier_stokes_rule_by_kernel", [&] {
    using T = scalar_t;
    return products<T>(grid, winds, /*beta=*/1.0, /*channels=*/2, lambda, u,
                       [&](const auto& pair, const auto& on_device, const T* given, const at::Tensor& out) {
                         const gpu::NavierStokesProductRule<T> of{pair, on_device, static_cast<int>(out.size(1)), given,
                                                                  out.mutable_data_ptr<T>()};
                         return gpu::each_point(out.device(), product_rule_body<T>("NavierStokesProductRule", kHeader),
                                                of, out.numel());
                       });
  });
}

}  // namespace prdp
