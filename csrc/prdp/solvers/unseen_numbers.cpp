#include "prdp/solvers/unseen_numbers.h"

#include <cmath>
#include <utility>

namespace prdp {

namespace {

/// Zero where the divisor is: of a sample that is solved exactly, and no product is to meet its NaN.
at::Tensor quotient(const at::Tensor& num, const at::Tensor& den) { return (num / den).nan_to_num_(0.0, 0.0, 0.0); }

}  // namespace

at::Tensor UnseenNumbers::step_length(const at::Tensor& num, const at::Tensor& den, const at::Tensor& a2,
                                      const at::Tensor& b2) {
  entries_.push_back({Kind::kStep});
  numbers_.insert(numbers_.end(), {num, den, a2, b2});
  return quotient(num, den);
}

at::Tensor UnseenNumbers::ratio(const at::Tensor& num, const at::Tensor& den) {
  entries_.push_back({Kind::kRatio});
  numbers_.push_back(den);
  return quotient(num, den);
}

void UnseenNumbers::expect_zero(const at::Tensor& number) {
  entries_.push_back({Kind::kZero});
  numbers_.push_back(number);
}

void UnseenNumbers::end_iteration(const at::Tensor& residual2) {
  if (residual2.defined()) {
    entries_.push_back({Kind::kResidual});
    numbers_.push_back(residual2);
  }
  entries_.push_back({Kind::kEnd, std::exchange(products_, 0)});
}

/// Rounding differs between host and device, so what is near a bound counts as odd.
bool UnseenNumbers::is_odd(Kind kind, const double* first, int64_t batch) const {
  switch (kind) {
    case Kind::kStep: {
      const double num = first[0], den = first[batch],
                   bound = std::sqrt(first[2 * batch]) * std::sqrt(first[3 * batch]);
      if (num == 0.0) return !std::isfinite(den);
      return !(num > 2.0 * negligible_ && std::abs(den) > 2.0 * epsilon_ * bound && std::isfinite(num / den));
    }
    case Kind::kRatio: return first[0] != 0.0 && !(first[0] > 2.0 * negligible_);
    case Kind::kZero: return first[0] != 0.0;
    default: return false;
  }
}

UnseenLog UnseenNumbers::read(int64_t batch) const {
  UnseenLog log;
  const auto host = numbers_.empty() ? at::empty({0}, at::kDouble) : at::cat(numbers_).to(at::kCPU, at::kDouble);
  const double* next = host.const_data_ptr<double>();
  std::vector<bool> odd(batch);
  for (const auto& entry : entries_) {
    switch (entry.kind) {
      case Kind::kEnd:
        log.odd.push_back(std::exchange(odd, std::vector<bool>(batch)));
        log.products.push_back(entry.products);
        continue;
      case Kind::kResidual: log.residual2.emplace_back(next, next + batch); break;
      default:
        for (int64_t i = 0; i < batch; ++i) odd[i] = odd[i] || is_odd(entry.kind, next + i, batch);
    }
    next += (entry.kind == Kind::kStep ? 4 : 1) * batch;
  }
  return log;
}

}  // namespace prdp
