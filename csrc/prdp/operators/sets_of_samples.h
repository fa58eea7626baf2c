#pragma once
#include <ATen/core/grad_mode.h>

#include <algorithm>

#include "prdp/operators/plain_tensors.h"
#include "prdp/threads/interruption.h"

/// Product rules by loops on the CPU.
namespace prdp {

/// Whether there are some for these tensors, and for a field that A is made of: plain ones, which autograd does not
/// record.
inline bool has_product_rule_loops(const at::Tensor& lambda, const at::Tensor& u, const at::Tensor& field) {
  return lambda.is_cpu() && !at::GradMode::is_enabled() && is_plain(lambda) && is_plain(u) && is_plain(field) &&
         lambda.numel() > 0;
}

/// The samples of a batch whose parts of a gradient add up at once: each alone where it has a field of its own; where
/// all share one, a few in their order, whatever the threads.
struct SetsOfSamples {
  int64_t batch, each, count;

  SetsOfSamples(int64_t samples, int64_t fields)
      : batch(samples),
        each(fields == 1 ? std::clamp<int64_t>(samples, 1, kMost) : 1),
        count((samples + each - 1) / each) {}

  /// Calls body(set, its first sample, how many) for each, of samples with `size` numbers.
  template <class Body>
  void share(int64_t size, const Body& body) const {
    constexpr int64_t worthwhile = 1 << 15;  // numbers for a thread
    interruption::parallel_for(0, count, std::max<int64_t>(1, worthwhile / (size * each)),
                               [&](int64_t begin, int64_t end) {
                                 for (int64_t set = begin; set < end; ++set)
                                   body(set, set * each, std::min(each, batch - set * each));
                               });
  }

 private:
  static constexpr int64_t kMost = 16;
};

}  // namespace prdp
