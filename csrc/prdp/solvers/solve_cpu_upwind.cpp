#include "prdp/kernels/upwind_factors.h"
#include "prdp/solvers/solve_cpu.h"

namespace prdp {

namespace {

/// `winds`: (batch or 1, channel, nx) or (batch or 1, channel, ny, nx).
template <class T>
kernels::UpwindParameters<T> upwind_parameters(const at::Tensor& winds, double nu, double dt,
                                               bool transposed) {
  return {winds.const_data_ptr<T>(),
          winds.size(0) == 1 ? 0 : winds.numel() / winds.size(0),
          winds.dim() > 3 ? winds.size(2) : 1,
          winds.size(-1),
          nu,
          dt,
          transposed};
}

}  // namespace

template <class T>
void solve_range(const BurgersParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end) {
  const auto p = upwind_parameters<T>(a.winds, a.nu, a.dt, a.transposed);
  if (a.winds.dim() == 3) return solve_samples(kernels::Burgers<T, 1>(p), batch, begin, end);
  solve_samples(kernels::Burgers<T, 2>(p), batch, begin, end);
}

template <class T>
void solve_range(const NavierStokesParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end) {
  const auto p = upwind_parameters<T>(a.velocity, a.nu, a.dt, a.transposed);
  solve_samples(kernels::NavierStokes<T>(p), batch, begin, end);
}

template void solve_range(const BurgersParameters&, const SampleBatch<float>&, int64_t, int64_t);
template void solve_range(const BurgersParameters&, const SampleBatch<double>&, int64_t, int64_t);
template void solve_range(const NavierStokesParameters&, const SampleBatch<float>&, int64_t, int64_t);
template void solve_range(const NavierStokesParameters&, const SampleBatch<double>&, int64_t, int64_t);

}  // namespace prdp
