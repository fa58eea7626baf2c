#include "prdp/autograd/tape_samples.h"

namespace prdp {

template <class T>
void reverse_range(const kernels::LaplacianParameters& a, const kernels::LaplacianParameters& transpose,
                   const ReverseBatch<T>& batch, int64_t begin, int64_t end) {
  detail::reverse_range(a, transpose, batch, begin, end);
}

template void reverse_range(const kernels::LaplacianParameters&, const kernels::LaplacianParameters&,
                            const ReverseBatch<float>&, int64_t, int64_t);
template void reverse_range(const kernels::LaplacianParameters&, const kernels::LaplacianParameters&,
                            const ReverseBatch<double>&, int64_t, int64_t);

}  // namespace prdp
