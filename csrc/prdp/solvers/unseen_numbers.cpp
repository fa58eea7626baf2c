#include "prdp/solvers/unseen_numbers.h"

#include <array>
#include <cmath>
#include <numeric>
#include <utility>

namespace prdp {

namespace {

/// Zero where the divisor is: of a sample that is solved exactly, and no product is to meet its NaN.
at::Tensor quotient(const at::Tensor& num, const at::Tensor& den) { return (num / den).nan_to_num_(0.0, 0.0, 0.0); }

}  // namespace

UnseenNumbers::UnseenNumbers(double epsilon, double negligible, const at::Tensor& residual2)
    : epsilon_(epsilon), negligible_(negligible) {
  if (residual2.defined()) descend(residual2, residual2);
}

void UnseenNumbers::note(Kind kind, std::initializer_list<at::Tensor> numbers, double factor) {
  entries_.push_back({kind, static_cast<int64_t>(numbers.size()), /*products=*/0, factor});
  numbers_.insert(numbers_.end(), numbers);
}

at::Tensor UnseenNumbers::step_length(const at::Tensor& num, const at::Tensor& den, const at::Tensor& a2,
                                      const at::Tensor& b2) {
  if (b2.defined()) note(Kind::kStep, {num, den, a2, b2});
  else if (a2.defined()) note(Kind::kStepToDescend, {num, den, a2});
  else note(Kind::kStepOfSquares, {num, den});
  return quotient(num, den);
}

at::Tensor UnseenNumbers::ratio(const at::Tensor& num, const at::Tensor& den) {
  note(Kind::kRatio, {den});
  return quotient(num, den);
}

at::Tensor UnseenNumbers::sum_of_squares(const at::Tensor& rr, const at::Tensor& beta) {
  note(Kind::kSumOfSquares, {rr, beta});
  return {};
}

void UnseenNumbers::descend(const at::Tensor& alpha, const at::Tensor& residual2) {
  note(Kind::kDescend, {alpha, residual2});
}

void UnseenNumbers::expect_positive(const at::Tensor& number, const at::Tensor& residual2) {
  note(Kind::kPositive, {number, residual2});
}

at::Tensor UnseenNumbers::expect_above_rounding(const at::Tensor& a, const at::Tensor& b2, const at::Tensor& c2,
                                                double factor) {
  note(Kind::kAboveRounding, {a, b2, c2}, factor);
  return {};
}

void UnseenNumbers::end_iteration(const at::Tensor& residual2) {
  if (residual2.defined()) note(Kind::kResidual, {residual2});
  entries_.push_back({Kind::kEnd, 0, std::exchange(products_, 0)});
}

/// Rounding differs between host and device, so what is near a bound counts as odd.
bool UnseenNumbers::is_odd_step(double num, double den, double a2, double b2) const {
  if (num == 0.0) return !std::isfinite(den);
  const double bound = std::sqrt(a2) * std::sqrt(b2);
  return !(num > 2.0 * negligible_ && std::abs(den) > 2.0 * epsilon_ * bound && std::isfinite(num / den));
}

/// `x`: the numbers of this entry and sample.
bool UnseenNumbers::is_odd(const Entry& entry, const std::array<double, 4>& x, Followed& sample) const {
  switch (entry.kind) {
    case Kind::kStep: return is_odd_step(x[0], x[1], x[2], x[3]);
    case Kind::kStepToDescend: sample.squares = x[2]; [[fallthrough]];
    case Kind::kStepOfSquares: sample.pending = {x[0], x[1], sample.squares}; return false;
    case Kind::kSumOfSquares: sample.squares = x[0] + x[1] * x[1] * sample.squares; return false;
    case Kind::kDescend: {
      const double before2 = std::exchange(sample.residual2, x[1]);
      const auto step = std::exchange(sample.pending, {});
      if (!step) return false;
      const double q = (std::sqrt(before2) + std::sqrt(x[1])) / std::abs(x[0]);  // at most
      return is_odd_step(step->num, step->den, step->a2, q * q);
    }
    case Kind::kRatio: return x[0] != 0.0 && !(x[0] > 2.0 * negligible_);
    case Kind::kPositive: return !(x[0] > 0.0) && x[1] != 0.0;
    case Kind::kAboveRounding: return std::abs(x[0]) < 1.001 * entry.factor * std::sqrt(x[1]) * std::sqrt(x[2]);
    default: return false;
  }
}

at::Tensor UnseenNumbers::broken() const {
  std::vector<at::Tensor> num, den, positive, residual2;
  auto next = numbers_.begin();
  for (const auto& entry : entries_) {
    if (entry.kind == Kind::kStep || entry.kind == Kind::kStepToDescend || entry.kind == Kind::kStepOfSquares) {
      num.push_back(next[0]);
      den.push_back(next[1]);
    } else if (entry.kind == Kind::kPositive) {
      positive.push_back(next[0]);
      residual2.push_back(next[1]);
    }
    next += entry.count;
  }
  if (num.empty()) return {};
  const auto above = at::stack(num), below = at::stack(den);
  const auto has_length = below.ne(0).logical_and((above / below).isfinite());
  auto rows = above.gt(negligible_).logical_and(has_length.logical_not()).any(0);
  if (!positive.empty()) {
    const auto wrong = at::stack(positive).gt(0).logical_not().logical_and(at::stack(residual2).gt(negligible_));
    rows = rows.logical_or(wrong.any(0));
  }
  return rows.flatten();
}

int64_t UnseenNumbers::products() const {
  return std::accumulate(entries_.begin(), entries_.end(), products_,
                         [](int64_t sum, const Entry& entry) { return sum + entry.products; });
}

UnseenLog UnseenNumbers::read(const double* next, int64_t batch) const {
  UnseenLog log;
  std::vector<bool> odd(batch);
  std::vector<Followed> samples(batch);
  for (const auto& entry : entries_) {
    if (entry.kind == Kind::kEnd) {
      log.odd.push_back(std::exchange(odd, std::vector<bool>(batch)));
      log.products.push_back(entry.products);
      continue;
    }
    if (entry.kind == Kind::kResidual) log.residual2.emplace_back(next, next + batch);
    for (int64_t i = 0; i < batch; ++i) {
      std::array<double, 4> x{};
      for (int64_t k = 0; k < entry.count; ++k) x[k] = next[k * batch + i];
      if (is_odd(entry, x, samples[i])) odd[i] = true;
    }
    next += entry.count * batch;
  }
  return log;
}

}  // namespace prdp
