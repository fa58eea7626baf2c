#include "prdp_experiments/training/failures.h"

#include <algorithm>

#include "prdp/solvers/status.h"

namespace prdp {

namespace {

/// The worst status of each sample in any of these solves.
std::vector<int64_t> worst(const std::vector<at::Tensor>& statuses) {
  std::vector<int64_t> of_samples;
  for (const auto& status : statuses) {
    const auto host = status.to(at::kCPU).contiguous();
    const int64_t batch = host.size(0), steps = host.dim() == 2 ? host.size(1) : 1;
    of_samples.resize(batch, static_cast<int64_t>(SolveStatus::kConverged));
    const auto* values = host.const_data_ptr<int64_t>();
    for (int64_t i = 0; i < batch * steps; ++i) of_samples[i / steps] = std::min(of_samples[i / steps], values[i]);
  }
  return of_samples;
}

bool failed(const std::vector<int64_t>& of_samples, size_t i) {
  return i < of_samples.size() && is_failure(static_cast<SolveStatus>(of_samples[i]));
}

}  // namespace

void Failures::take(const std::vector<at::Tensor>& forward, const std::vector<at::Tensor>& adjoint,
                    const std::optional<at::Tensor>& samples) {
  const auto primal = worst(forward), dual = worst(adjoint);
  for (size_t i = 0; i < primal.size(); ++i) {
    const bool in_forward = failed(primal, i);
    if (!in_forward && !failed(dual, i)) continue;
    ++count_;
    constexpr size_t kNamed = 4;
    if (named_.size() >= kNamed) continue;
    const auto number = samples ? (*samples)[static_cast<int64_t>(i)].item<int64_t>() : static_cast<int64_t>(i);
    const auto why = static_cast<SolveStatus>(in_forward ? primal[i] : dual[i]);
    named_.push_back("sample " + std::to_string(number) + " " + name(why) + " in the " +
                     (in_forward ? "forward" : "adjoint") + " solve");
  }
}

std::string Failures::line(int64_t interval) const {
  if (count_ == 0) return {};
  auto text = "interval " + std::to_string(interval) + ": " + std::to_string(count_) + " failed sample" +
              (count_ == 1 ? "" : "s");
  for (size_t i = 0; i < named_.size(); ++i) text += (i ? ", " : ": ") + named_[i];
  const auto more = count_ - static_cast<int64_t>(named_.size());
  return more > 0 ? text + ", and " + std::to_string(more) + " more" : text;
}

}  // namespace prdp
