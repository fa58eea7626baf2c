#pragma once
#include <ATen/ATen.h>

#include <cstdint>
#include <vector>

#include "prdp/solvers/run_unseen.h"

namespace prdp {

/// The numbers of iterations that the host does not watch. A quotient is taken as it comes; what it is made of is kept
/// on the device, and tells the host later whether a watched iteration would have made something else of it.
class UnseenNumbers {
 public:
  UnseenNumbers(double epsilon, double negligible) : epsilon_(epsilon), negligible_(negligible) {}

  /// As those of TensorSpace, where nothing breaks down and nothing is negligible.
  at::Tensor step_length(const at::Tensor& num, const at::Tensor& den, const at::Tensor& a2, const at::Tensor& b2);
  at::Tensor ratio(const at::Tensor& num, const at::Tensor& den);
  void expect_zero(const at::Tensor& number);

  void count() { ++products_; }
  /// `residual2` may be undefined.
  void end_iteration(const at::Tensor& residual2);
  /// All of it, in one copy.
  UnseenLog read(int64_t batch) const;

 private:
  enum class Kind { kStep, kRatio, kZero, kResidual, kEnd };
  struct Entry {
    Kind kind;
    int64_t products = 0;
  };
  bool is_odd(Kind kind, const double* first, int64_t batch) const;

  double epsilon_, negligible_;
  int64_t products_ = 0;  // of this iteration
  std::vector<Entry> entries_;
  std::vector<at::Tensor> numbers_;  // (batch, 1, …) each, in the order of the entries
};

}  // namespace prdp
