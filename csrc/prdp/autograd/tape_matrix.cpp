#include "prdp/autograd/tape_samples.h"

namespace prdp {

template <class T>
void reverse_range(const DenseParameters& a, const DenseParameters& transpose, const ReverseBatch<T>& batch,
                   int64_t begin, int64_t end) {
  detail::reverse_range(a, transpose, batch, begin, end);
}

template <class T>
void reverse_range(const CsrParameters& a, const CsrParameters& transpose, const ReverseBatch<T>& batch, int64_t begin,
                   int64_t end) {
  detail::reverse_range(a, transpose, batch, begin, end);
}

template void reverse_range(const DenseParameters&, const DenseParameters&, const ReverseBatch<float>&, int64_t,
                            int64_t);
template void reverse_range(const DenseParameters&, const DenseParameters&, const ReverseBatch<double>&, int64_t,
                            int64_t);
template void reverse_range(const CsrParameters&, const CsrParameters&, const ReverseBatch<float>&, int64_t, int64_t);
template void reverse_range(const CsrParameters&, const CsrParameters&, const ReverseBatch<double>&, int64_t, int64_t);

}  // namespace prdp
