#include "prdp_experiments/networks/weights.h"

#include <caffe2/serialize/inline_container.h>
#include <torch/csrc/jit/serialization/pickler.h>

#include "prdp_experiments/files/saved.h"
#include "prdp_experiments/files/whole_files.h"

namespace prdp {

namespace {

TensorMap read(std::string_view bytes) {
  try {
    return unpack(bytes);
  } catch (const c10::ValueError&) {
    TORCH_CHECK_VALUE(false,
                      "weights: expected a dict of tensors, as torch.save(network.state_dict(), path) writes it");
  }
}

}  // namespace

std::string pack_weights(const torch::nn::Module& network) {
  c10::Dict<std::string, at::Tensor> state;
  for (const auto& weight : network.named_parameters()) state.insert(weight.key(), weight.value().detach().cpu());
  // torch::jit::pickle_save does the same but for one thing: it marks the types of what is in the dict, by a function
  // that torch.load(weights_only=True) refuses to call.
  std::string pickled, file;
  torch::jit::Pickler pickler([&](const char* data, size_t size) { pickled.append(data, size); }, nullptr, nullptr,
                              nullptr, nullptr, /*tag_aggregates=*/false);
  pickler.protocol();
  pickler.pushIValue(state);
  pickler.stop();
  caffe2::serialize::PyTorchStreamWriter writer([&](const void* data, size_t size) {
    file.append(static_cast<const char*>(data), size);
    return size;
  });
  for (size_t i = 0; i < pickler.tensorData().size(); ++i) {
    const auto data = torch::jit::getWriteableTensorData(pickler.tensorData()[i]);
    writer.writeRecord("data/" + std::to_string(i), data.data(), data.sizeInBytes());
  }
  writer.writeRecord("data.pkl", pickled.data(), pickled.size());
  writer.writeEndOfFile();
  return file;
}

void unpack_weights(const std::string& bytes, torch::nn::Module& network) {
  Saved state(read(bytes));
  const auto weights = network.named_parameters();
  std::vector<at::Tensor> tensors;
  try {
    for (const auto& weight : weights)
      tensors.push_back(state.take(weight.key(), weight.value().scalar_type(), weight.value().sizes()));
    state.finish();
  } catch (const c10::ValueError& error) {
    TORCH_CHECK_VALUE(false, "weights: ", error.what_without_backtrace());
  }
  const torch::NoGradGuard no_grad;
  for (size_t i = 0; i < tensors.size(); ++i) weights[i].value().detach().copy_(tensors[i]);
}

void load_weights(const std::filesystem::path& path, torch::nn::Module& network) {
  const auto bytes = read_whole("weights", path);
  try {
    unpack_weights(bytes, network);
  } catch (const c10::ValueError& error) {
    TORCH_CHECK_VALUE(false, error.what_without_backtrace(), ", in '", path.string(), "'");
  }
}

}  // namespace prdp
