#include "prdp_experiments/training/progress.h"

#include <c10/util/Exception.h>

#include <cmath>
#include <limits>
#include <string_view>

namespace prdp::train {

namespace {

template <class T>
void put(TensorMap& tensors, const std::string& name, const std::vector<T>& values) {
  tensors[name] = at::tensor(values, at::TensorOptions(c10::CppTypeToScalarType<T>::value));
}

/// How many entries a curve has.
int64_t length_of(std::string_view name, int64_t done, int64_t updates_per_interval) {
  if (name == "update_loss") return done * updates_per_interval;
  return done + (name == "metric" || name == "error");
}

constexpr Range kNotNegative{.least = 0.0};

}  // namespace

void save(TensorMap& tensors, const Curves& curves, const Controller::State& controller) {
  each_curve(curves, [&](const std::string& name, const auto& values) { put(tensors, name, values); });
  std::vector<double> metric, smoothed;
  std::vector<int64_t> max_iter, refined;
  std::vector<double> error, residual;  // NaN where not known
  for (const auto& record : controller.history) {
    error.push_back(record.error.value_or(NAN));
    residual.push_back(record.residual.value_or(NAN));
    metric.push_back(record.metric);
    smoothed.push_back(record.smoothed);
    max_iter.push_back(record.max_iter);
    refined.push_back(record.refined);
  }
  put<int64_t>(tensors, "controller_max_iter", {controller.max_iter});
  put<double>(tensors, "controller_checkpoint", {controller.checkpoint});
  put(tensors, "history_metric", metric);
  put(tensors, "history_smoothed", smoothed);
  put(tensors, "history_max_iter", max_iter);
  put(tensors, "history_refined", refined);
  put(tensors, "history_error", error);
  put(tensors, "history_residual", residual);
}

Progress load_progress(Saved& saved, int64_t updates_per_interval) {
  Progress progress;
  const int64_t done = saved.length("seconds");
  TORCH_CHECK_VALUE(done >= 1, "tensor 'seconds' is empty, and no training is kept before its first interval");
  each_curve(progress.curves, [&]<class T>(const std::string& name, std::vector<T>& values) {
    values = saved.list<T>(name, length_of(name, done, updates_per_interval), kNotNegative);
  });

  auto& state = progress.controller;
  state.max_iter = saved.list<int64_t>("controller_max_iter", 1, kNotNegative)[0];
  state.checkpoint = saved.list<double>("controller_checkpoint", 1, {.least = 0.0, .finite = false})[0];
  // A schedule keeps the last record only.
  const int64_t n = saved.length("history_metric");
  TORCH_CHECK_VALUE(n == 1 || n == done + 1, "tensor 'history_metric' has ", n, " entries after ", done, " intervals");
  const Range known_or_nan{.least = 0.0, .unknown_is_nan = true};
  const auto metric = saved.list<double>("history_metric", n, kNotNegative);
  const auto smoothed = saved.list<double>("history_smoothed", n, kNotNegative);
  const auto max_iter = saved.list<int64_t>("history_max_iter", n, kNotNegative);
  const auto refined = saved.list<int64_t>("history_refined", n, {.least = 0.0, .most = 1.0});
  const auto error = saved.list<double>("history_error", n, known_or_nan);
  const auto residual = saved.list<double>("history_residual", n, known_or_nan);
  const auto known = [](double x) { return std::isnan(x) ? std::optional<double>() : x; };
  for (int64_t i = 0; i < n; ++i)
    state.history.push_back(
        {metric[i], smoothed[i], max_iter[i], refined[i] != 0, known(error[i]), known(residual[i])});
  return progress;
}

}  // namespace prdp::train
