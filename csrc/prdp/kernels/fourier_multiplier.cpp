#include "prdp/kernels/fourier_multiplier.h"

#include <ATen/ATen.h>

#include <algorithm>

namespace prdp::kernels {

template <class T>
FourierMultiplier<T>::FourierMultiplier(const std::array<int64_t, 3>& shape, const std::vector<double>& numbers)
    : shape_(shape) {
  const int64_t nx = shape[2], rows = shape[0] * shape[1], kept = nx / 2 + 1;
  const double scale = 1.0 / static_cast<double>(rows * nx);
  numbers_.reserve(rows * kept);
  for (int64_t r = 0; r < rows; ++r)
    for (int64_t k = 0; k < kept; ++k) numbers_.push_back(static_cast<T>(numbers[r * nx + k] * scale));
}

template <class T>
void FourierMultiplier<T>::apply(std::vector<T>& field) const {
  const at::AutoDispatchBelowADInplaceOrView below_autograd;
  // In memory of torch's own, whose alignment is always the same: so are the last bits.
  const auto values = at::empty(shape_, c10::CppTypeToScalarType<T>::value);
  std::copy(field.begin(), field.end(), values.template mutable_data_ptr<T>());
  constexpr int64_t unscaled = 0;
  const std::array<int64_t, 3> axes{0, 1, 2};
  const at::IntArrayRef along = shape_[0] == 1 ? at::IntArrayRef(axes).slice(1) : at::IntArrayRef(axes);
  const auto waves = at::_fft_r2c(values, along, unscaled, /*onesided=*/true);
  auto* wave = waves.template mutable_data_ptr<c10::complex<T>>();
  for (const T number : numbers_) *wave++ *= number;
  const auto back = at::_fft_c2r(waves, along, unscaled, shape_[2]);
  std::copy_n(back.template const_data_ptr<T>(), field.size(), field.begin());
}

template class FourierMultiplier<float>;
template class FourierMultiplier<double>;

}  // namespace prdp::kernels
