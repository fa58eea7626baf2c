#include "prdp/solvers/solve_cpu.h"
#include "prdp/solvers/with_kernel.h"

namespace prdp {

template <class T>
void solve_range(const kernels::LaplacianParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end) {
  with_kernel<T>(a, [&](const auto& kernel) { solve_samples(kernel, batch, begin, end); });
}

template void solve_range(const kernels::LaplacianParameters&, const SampleBatch<float>&, int64_t, int64_t);
template void solve_range(const kernels::LaplacianParameters&, const SampleBatch<double>&, int64_t, int64_t);

}  // namespace prdp
