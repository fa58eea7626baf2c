#include "prdp/solvers/solve_cpu.h"

namespace prdp {

template <class T>
void solve_range(const kernels::LaplacianParameters& a, const SampleBatch<T>& batch, int64_t begin,
                 int64_t end) {
  switch (a.dim) {
    case 1: return solve_samples(kernels::Laplacian<T, 1>(a), batch, begin, end);
    case 2: return solve_samples(kernels::Laplacian<T, 2>(a), batch, begin, end);
    case 3: return solve_samples(kernels::Laplacian<T, 3>(a), batch, begin, end);
  }
}

template void solve_range(const kernels::LaplacianParameters&, const SampleBatch<float>&, int64_t, int64_t);
template void solve_range(const kernels::LaplacianParameters&, const SampleBatch<double>&, int64_t, int64_t);

}  // namespace prdp
