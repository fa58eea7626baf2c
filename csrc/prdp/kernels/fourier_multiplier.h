#pragma once
#include <array>
#include <cstdint>
#include <vector>

namespace prdp::kernels {

/// The operator on a periodic grid (nz, ny, nx) that multiplies each wave by a number, by PyTorch's FFT.
template <class T>
class FourierMultiplier {
 public:
  /// `numbers`: one for each triple of wavenumbers, in the order of the grid, and the same for k and -k.
  FourierMultiplier(const std::array<int64_t, 3>& shape, const std::vector<double>& numbers);

  /// Any thread may call this.
  void apply(std::vector<T>& field) const;
  int64_t bytes() const { return static_cast<int64_t>(numbers_.size() * sizeof(T)); }

 private:
  std::array<int64_t, 3> shape_;
  std::vector<T> numbers_;  // of the waves that a real transform keeps, and of its scale
};

}  // namespace prdp::kernels
