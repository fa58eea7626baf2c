#include "prdp/solvers/solve_cpu.h"

namespace prdp {

template <class T>
void solve_range(const DenseParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end) {
  const int64_t n = a.matrix.size(-1);
  const int64_t sample_stride = a.matrix.dim() == 2 ? 0 : n * n;
  const kernels::Dense<T> kernel(a.matrix.const_data_ptr<T>(), n, sample_stride, a.transposed);
  solve_samples(kernel, batch, begin, end);
}

template <class T>
void solve_range(const CsrParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end) {
  const kernels::Csr<T> kernel(a.crow.const_data_ptr<int64_t>(), a.col.const_data_ptr<int64_t>(),
                               a.values.const_data_ptr<T>(), a.crow.size(-1) - 1, a.values.size(-1),
                               /*is_shared=*/a.values.dim() == 1, a.transposed);
  solve_samples(kernel, batch, begin, end);
}

template void solve_range(const DenseParameters&, const SampleBatch<float>&, int64_t, int64_t);
template void solve_range(const DenseParameters&, const SampleBatch<double>&, int64_t, int64_t);
template void solve_range(const CsrParameters&, const SampleBatch<float>&, int64_t, int64_t);
template void solve_range(const CsrParameters&, const SampleBatch<double>&, int64_t, int64_t);

}  // namespace prdp
