#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp/gpu/device/broadcast_sum.h"

namespace prdp {

/// The cotangents of tensors that share products (batch, channels, *shape), as a kernel sums them up: where the memory
/// of its sums is, and what they are.
class BroadcastSums {
 public:
  explicit BroadcastSums(const at::Tensor& products) : like_(products) {}

  /// For a tensor with the axes of the products, each of the same extent or of one; or without axes. The products
  /// have one point along the axis `across` of the grid, if there is such an axis.
  gpu::BroadcastSum add(const at::Tensor& of, int64_t across = -1);
  /// How many have been added: the index that the next one gets.
  size_t size() const { return sums_.size(); }
  /// Of all sums.
  int64_t count() const { return count_; }
  /// Where the kernel puts the k-th sum. All have been added.
  double* memory(size_t k);
  /// The k-th sum, once the kernel has run: like the tensor it is of, on the device.
  at::Tensor result(size_t k) const;

 private:
  struct Sum {
    std::vector<int64_t> sizes;
    int64_t first, parts, count;
  };
  at::Tensor like_, memory_;
  std::vector<Sum> sums_;
  int64_t count_ = 0;
};

}  // namespace prdp
