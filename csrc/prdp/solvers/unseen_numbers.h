#pragma once
#include <ATen/ATen.h>

#include <array>
#include <cstdint>
#include <initializer_list>
#include <optional>
#include <vector>

#include "prdp/solvers/run_unseen.h"

namespace prdp {

/// The numbers of iterations that the host does not watch. A quotient is taken as it comes; what it is made of is kept
/// on the device, and tells the host later whether a watched iteration would have made something else of it.
class UnseenNumbers {
 public:
  /// `residual2`: before the first iteration, of methods that descend.
  UnseenNumbers(double epsilon, double negligible, const at::Tensor& residual2);

  /// As those of TensorSpace, where nothing breaks down and nothing is negligible. Without b2 it is judged by what
  /// descend() tells, and without a2 by sum_of_squares(): to compute them would take more than the step.
  at::Tensor step_length(const at::Tensor& num, const at::Tensor& den, const at::Tensor& a2, const at::Tensor& b2);
  at::Tensor ratio(const at::Tensor& num, const at::Tensor& den);
  at::Tensor sum_of_squares(const at::Tensor& rr, const at::Tensor& beta);
  /// r has moved by alpha q, where b2 is the square of the norm of q; `residual2` is that of r.
  void descend(const at::Tensor& alpha, const at::Tensor& residual2);
  void expect_positive(const at::Tensor& number, const at::Tensor& residual2);
  at::Tensor expect_above_rounding(const at::Tensor& a, const at::Tensor& b2, const at::Tensor& c2, double factor);

  void count() { ++products_; }
  /// `residual2` may be undefined.
  void end_iteration(const at::Tensor& residual2);
  /// All of them in a row, on the device; undefined if there are none.
  at::Tensor numbers() const { return numbers_.empty() ? at::Tensor() : at::cat(numbers_).flatten(); }
  /// What they say, from a copy of numbers().
  UnseenLog read(const double* numbers, int64_t batch) const;
  /// Where a step had no length though a residual was left, or a number that must be positive was not: (batch,), on the
  /// device; undefined if nothing can break down.
  at::Tensor broken() const;
  /// Since the beginning.
  int64_t products() const;

 private:
  enum class Kind {
    kStep,
    kStepToDescend,   // without b2
    kStepOfSquares,   // without a2 and b2
    kRatio,
    kSumOfSquares,
    kDescend,
    kPositive,
    kAboveRounding,
    kResidual,
    kEnd
  };
  struct Entry {
    Kind kind;
    int64_t count = 0;      // of numbers
    int64_t products = 0;
    double factor = 0.0;
  };
  void note(Kind kind, std::initializer_list<at::Tensor> numbers, double factor = 0.0);
  /// What the host follows of one sample.
  struct Followed {
    double residual2 = 0.0, squares = 0.0;
    struct Step {
      double num, den, a2;
    };
    std::optional<Step> pending{};  // until descend() tells its b2
  };
  bool is_odd_step(double num, double den, double a2, double b2) const;
  bool is_odd(const Entry& entry, const std::array<double, 4>& numbers, Followed& sample) const;

  double epsilon_, negligible_;
  int64_t products_ = 0;  // of this iteration
  std::vector<Entry> entries_;
  std::vector<at::Tensor> numbers_;  // (batch, 1, …) each, in the order of the entries
};

}  // namespace prdp
