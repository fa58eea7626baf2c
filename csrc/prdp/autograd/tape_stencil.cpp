#include "prdp/autograd/tape_samples.h"
#include "prdp/kernels/stencil_factors.h"

namespace prdp {

template <class T>
void reverse_range(const BurgersParameters& a, const BurgersParameters& transpose, const ReverseBatch<T>& batch,
                   int64_t begin, int64_t end) {
  detail::reverse_range(a, transpose, batch, begin, end);
}

template <class T>
void reverse_range(const StencilParameters& a, const StencilParameters& transpose, const ReverseBatch<T>& batch,
                   int64_t begin, int64_t end) {
  detail::reverse_range(a, transpose, batch, begin, end);
}

template void reverse_range(const BurgersParameters&, const BurgersParameters&, const ReverseBatch<float>&, int64_t,
                            int64_t);
template void reverse_range(const BurgersParameters&, const BurgersParameters&, const ReverseBatch<double>&, int64_t,
                            int64_t);
template void reverse_range(const StencilParameters&, const StencilParameters&, const ReverseBatch<float>&, int64_t,
                            int64_t);
template void reverse_range(const StencilParameters&, const StencilParameters&, const ReverseBatch<double>&, int64_t,
                            int64_t);

}  // namespace prdp
