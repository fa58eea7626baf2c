#include "prdp/autograd/tape_samples.h"
#include "prdp/kernels/navier_stokes_factors.h"

namespace prdp {

template <class T>
void reverse_range(const NavierStokesParameters& a, const NavierStokesParameters& transpose,
                   const ReverseBatch<T>& batch, int64_t begin, int64_t end) {
  detail::reverse_range(a, transpose, batch, begin, end);
}

template void reverse_range(const NavierStokesParameters&, const NavierStokesParameters&, const ReverseBatch<float>&,
                            int64_t, int64_t);
template void reverse_range(const NavierStokesParameters&, const NavierStokesParameters&, const ReverseBatch<double>&,
                            int64_t, int64_t);

}  // namespace prdp
