#include "prdp_experiments/training/state.h"

#include <ATen/CPUGeneratorImpl.h>

#include <cmath>
#include <optional>

namespace prdp::train {

namespace {

template <class T>
void put(TensorMap& tensors, const std::string& name, const std::vector<T>& values) {
  tensors[name] = at::tensor(values, at::TensorOptions(c10::CppTypeToScalarType<T>::value));
}

/// As many values as there are.
template <class T>
std::vector<T> get(const TensorMap& tensors, const std::string& name) {
  const auto found = tensors.find(name);
  const int64_t n = found == tensors.end() ? 0 : found->second.numel();
  const auto values = entry(tensors, name, c10::CppTypeToScalarType<T>::value, {n}).contiguous();
  return {values.template const_data_ptr<T>(), values.template const_data_ptr<T>() + n};
}

template <class T>
T get_one(const TensorMap& tensors, const std::string& name) {
  return entry(tensors, name, c10::CppTypeToScalarType<T>::value, {1}).template item<T>();
}

void save(TensorMap& tensors, const std::string& name, const at::Generator& generator) {
  tensors[name] = generator.get_state();
}

void load(const TensorMap& tensors, const std::string& name, at::Generator generator) {
  const auto now = generator.get_state();
  generator.set_state(entry(tensors, name, now.scalar_type(), now.sizes()));
}

}  // namespace

void save(TensorMap& tensors, const Curves& curves, const Controller& controller) {
  each_curve(curves, [&](const std::string& name, const auto& values) { put(tensors, name, values); });
  const auto& state = controller.state();
  std::vector<double> metric, smoothed;
  std::vector<int64_t> max_iter, refined;
  std::vector<double> error, residual;  // NaN where not known
  for (const auto& record : state.history) {
    error.push_back(record.error.value_or(NAN));
    residual.push_back(record.residual.value_or(NAN));
    metric.push_back(record.metric);
    smoothed.push_back(record.smoothed);
    max_iter.push_back(record.max_iter);
    refined.push_back(record.refined);
  }
  put<int64_t>(tensors, "controller_max_iter", {state.max_iter});
  put<double>(tensors, "controller_checkpoint", {state.checkpoint});
  put(tensors, "history_metric", metric);
  put(tensors, "history_smoothed", smoothed);
  put(tensors, "history_max_iter", max_iter);
  put(tensors, "history_refined", refined);
  put(tensors, "history_error", error);
  put(tensors, "history_residual", residual);
}

void load(const TensorMap& tensors, Curves& curves, Controller& controller) {
  each_curve(curves, [&]<class T>(const std::string& name, std::vector<T>& values) { values = get<T>(tensors, name); });
  TORCH_CHECK_VALUE(curves.metric.size() == curves.seconds.size() + 1, "a metric too many or too few");
  Controller::State state{get_one<int64_t>(tensors, "controller_max_iter"),
                          get_one<double>(tensors, "controller_checkpoint")};
  const auto metric = get<double>(tensors, "history_metric"), smoothed = get<double>(tensors, "history_smoothed");
  const auto max_iter = get<int64_t>(tensors, "history_max_iter"), refined = get<int64_t>(tensors, "history_refined");
  const auto error = get<double>(tensors, "history_error"), residual = get<double>(tensors, "history_residual");
  const auto n = metric.size();
  for (const auto size : {smoothed.size(), max_iter.size(), refined.size(), error.size(), residual.size()})
    TORCH_CHECK_VALUE(size == n, "a torn history");
  const auto known = [](double x) { return std::isnan(x) ? std::optional<double>() : x; };
  for (size_t i = 0; i < n; ++i)
    state.history.push_back(
        {metric[i], smoothed[i], max_iter[i], refined[i] != 0, known(error[i]), known(residual[i])});
  controller.load_state(std::move(state));
}

void save(TensorMap& tensors, const torch::nn::Module& network, const FusedAdam& optimiser,
          const at::Generator& shuffling) {
  for (const auto& weight : network.named_parameters()) tensors["network." + weight.key()] = weight.value();
  optimiser.save(tensors);
  save(tensors, "shuffling", shuffling);
  save(tensors, "random", at::detail::getDefaultCPUGenerator());
}

void load(const TensorMap& tensors, torch::nn::Module& network, FusedAdam& optimiser, at::Generator& shuffling) {
  const torch::NoGradGuard no_grad;
  for (auto& weight : network.named_parameters()) {
    auto& now = weight.value();
    now.copy_(entry(tensors, "network." + weight.key(), now.scalar_type(), now.sizes()));
  }
  optimiser.load(tensors);
  load(tensors, "shuffling", shuffling);
  load(tensors, "random", at::detail::getDefaultCPUGenerator());
}

}  // namespace prdp::train
