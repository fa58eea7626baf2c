#pragma once
#include <cmath>

#include "prdp/kernels/kernel.h"
#include "prdp/kernels/upwind_rows.h"
#include "prdp/operators/upwind_operator.h"

namespace prdp {

template <class Make>
std::shared_ptr<const kernels::Kernels> UpwindOperator::upwind_kernels(const at::Tensor& b, bool transposed,
                                                                       const Make& make) const {
  const auto dim = static_cast<size_t>(grid_.dim());
  double length[2] = {1.0, 1.0};
  int64_t extent[2] = {1, 1};  // along y and x
  for (size_t d = 0; d < dim; ++d) {
    length[2 - dim + d] = grid_.length(static_cast<int64_t>(d));
    extent[2 - dim + d] = grid_.shape()[d];
  }
  const auto of_samples = [=, winds = winds_.detach().to(at::kCPU).contiguous(), nu = step_.nu_values(),
                           dt = step_.dt]<class T>(T) -> kernels::KernelBatch<T> {
    const int64_t stride = winds.size(0) == 1 ? 0 : winds.stride(0);
    using Parameters = kernels::UpwindParameters<T>;
    const auto pattern = Parameters::of_grid(static_cast<int64_t>(dim), extent[0], extent[1]);
    return {winds.size(0) == 1 && nu.size() == 1, [=](int64_t s) {
              const double mine = nu[nu.size() == 1 ? 0 : s];
              const auto p = Parameters{winds.const_data_ptr<T>() + s * stride,
                                        extent[0],
                                        extent[1],
                                        mine,
                                        dt,
                                        transposed,
                                        length[0],
                                        length[1],
                                        pattern};
              return std::isfinite(mine) ? make(p) : nullptr;
            }};
  };
  return kernels::make_kernels(b.scalar_type() == at::kFloat, of_samples);
}

}  // namespace prdp
