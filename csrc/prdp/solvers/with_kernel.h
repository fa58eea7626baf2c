#pragma once
#include "prdp/kernels/burgers.h"
#include "prdp/kernels/given_stencil.h"
#include "prdp/kernels/laplacian.h"
#include "prdp/kernels/matrix.h"
#include "prdp/kernels/navier_stokes.h"
#include "prdp/operators/operator.h"

/// From what an operator tells the CPU loops to its kernel: with_kernel<T>(parameters, body) calls
/// body(kernel).
namespace prdp {

template <class T, class Body>
void with_kernel(const kernels::LaplacianParameters& a, const Body& body) {
  switch (a.dim) {
    case 1: return body(kernels::Laplacian<T, 1>(a));
    case 2: return body(kernels::Laplacian<T, 2>(a));
    case 3: return body(kernels::Laplacian<T, 3>(a));
  }
}

template <class T, class Body>
void with_kernel(const DenseParameters& a, const Body& body) {
  const int64_t n = a.matrix.size(-1);
  const int64_t sample_stride = a.matrix.dim() == 2 ? 0 : n * n;
  body(kernels::Dense<T>(a.matrix.const_data_ptr<T>(), n, sample_stride, a.transposed));
}

template <class T, class Body>
void with_kernel(const CsrParameters& a, const Body& body) {
  body(kernels::Csr<T>(a.crow.const_data_ptr<int64_t>(), a.col.const_data_ptr<int64_t>(), a.values.const_data_ptr<T>(),
                       a.crow.size(-1) - 1, a.values.size(-1),
                       /*is_shared=*/a.values.dim() == 1, a.transposed));
}

/// `winds`: (batch or 1, channel, nx) or (batch or 1, channel, ny, nx).
template <class T, class Parameters>
kernels::UpwindParameters<T> upwind_parameters(const at::Tensor& winds, const Parameters& a) {
  return {winds.const_data_ptr<T>(),
          winds.size(0) == 1 ? 0 : winds.numel() / winds.size(0),
          winds.dim() > 3 ? winds.size(2) : 1,
          winds.size(-1),
          a.nu,
          a.dt,
          a.transposed,
          a.length[0],
          a.length[1]};
}

template <class T, class Body>
void with_kernel(const BurgersParameters& a, const Body& body) {
  body(kernels::burgers(upwind_parameters<T>(a.winds, a), a.winds.dim() - 2));
}

template <class T, class Body>
void with_kernel(const StencilParameters& a, const Body& body) {
  auto offsets = a.offsets;
  if (a.transposed)
    for (auto& offset : offsets)
      for (auto& cells : offset.along) cells = -cells;
  const int64_t batch = a.coefficients.size(0);
  const kernels::GivenStencil<T> given{a.coefficients.const_data_ptr<T>(),
                                       batch == 1 ? 0 : a.coefficients.numel() / batch,
                                       std::make_shared<kernels::StencilPattern>(a.grid, offsets), a.transposed};
  body(kernels::given_stencil(given, a.channels));
}

template <class T, class Body>
void with_kernel(const NavierStokesParameters& a, const Body& body) {
  body(kernels::NavierStokes<T>(upwind_parameters<T>(a.velocity, a)));
}

}  // namespace prdp
