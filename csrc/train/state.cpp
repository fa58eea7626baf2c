#include "state.h"

#include <cmath>
#include <optional>
#include <sstream>

namespace prdp::train {

namespace {

template <class T>
T read(InputArchive& archive, const std::string& key) {
  c10::IValue value;
  archive.read(key, value);
  return value.to<T>();
}

}  // namespace

void save(OutputArchive& archive, const Curves& curves, const Controller& controller) {
  each_curve(curves, [&](const std::string& name, const auto& values) {
    archive.write(name, c10::IValue(values));
  });
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
  archive.write("controller_max_iter", c10::IValue(state.max_iter));
  archive.write("controller_checkpoint", c10::IValue(state.checkpoint));
  archive.write("history_metric", c10::IValue(metric));
  archive.write("history_smoothed", c10::IValue(smoothed));
  archive.write("history_max_iter", c10::IValue(max_iter));
  archive.write("history_refined", c10::IValue(refined));
  archive.write("history_error", c10::IValue(error));
  archive.write("history_residual", c10::IValue(residual));
}

void load(InputArchive& archive, Curves& curves, Controller& controller) {
  each_curve(curves, [&](const std::string& name, auto& values) {
    values = read<std::remove_reference_t<decltype(values)>>(archive, name);
  });
  Controller::State state{read<int64_t>(archive, "controller_max_iter"),
                          read<double>(archive, "controller_checkpoint")};
  const auto metric = read<std::vector<double>>(archive, "history_metric");
  const auto smoothed = read<std::vector<double>>(archive, "history_smoothed");
  const auto max_iter = read<std::vector<int64_t>>(archive, "history_max_iter");
  const auto refined = read<std::vector<int64_t>>(archive, "history_refined");
  const auto error = read<std::vector<double>>(archive, "history_error");
  const auto residual = read<std::vector<double>>(archive, "history_residual");
  const auto known = [](double x) { return std::isnan(x) ? std::optional<double>() : x; };
  for (size_t i = 0; i < metric.size(); ++i)
    state.history.push_back(
        {metric[i], smoothed[i], max_iter[i], refined[i] != 0, known(error[i]), known(residual[i])});
  controller.load_state(std::move(state));
}

void save(OutputArchive& archive, const torch::nn::Module& network,
          const torch::optim::Optimizer& optimiser, const at::Generator& shuffling) {
  OutputArchive weights(archive.compilation_unit()), moments(archive.compilation_unit());
  network.save(weights);
  optimiser.save(moments);
  archive.write("network", weights);
  archive.write("optimiser", moments);
  archive.write("shuffling", shuffling.get_state(), /*is_buffer=*/true);
}

void load(InputArchive& archive, torch::nn::Module& network, torch::optim::Optimizer& optimiser,
          at::Generator& shuffling) {
  InputArchive weights, moments;
  at::Tensor state;
  archive.read("network", weights);
  archive.read("optimiser", moments);
  archive.read("shuffling", state, /*is_buffer=*/true);
  network.load(weights);
  optimiser.load(moments);
  shuffling.set_state(state);
}

std::string bytes_of(OutputArchive& archive) {
  std::ostringstream bytes;
  archive.save_to(bytes);
  return bytes.str();
}

InputArchive archive_of(const std::string& bytes) {
  InputArchive archive;
  archive.load_from(bytes.data(), bytes.size());
  return archive;
}

}  // namespace prdp::train
