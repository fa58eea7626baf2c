#include "prdp/scenes/pickled.h"

#include <c10/util/Exception.h>
#include <caffe2/serialize/inline_container.h>
#include <caffe2/serialize/read_adapter_interface.h>
#include <torch/csrc/jit/serialization/import_read.h>

#include <algorithm>
#include <cstring>

namespace prdp {

namespace {

/// Bytes in memory. Those of torch::jit::pickle_load read beyond the end where a damaged archive says so.
class Bytes final : public caffe2::serialize::ReadAdapterInterface {
 public:
  explicit Bytes(std::string_view all) : all_(all) {}
  size_t size() const override { return all_.size(); }
  size_t read(uint64_t from, void* to, size_t count, const char*) const override {
    if (from >= all_.size()) return 0;
    count = std::min(count, all_.size() - static_cast<size_t>(from));
    std::memcpy(to, all_.data() + from, count);
    return count;
  }

 private:
  std::string_view all_;
};

}  // namespace

c10::IValue read_pickled(std::string_view bytes) {
  try {
    caffe2::serialize::PyTorchStreamReader reader(std::make_shared<Bytes>(bytes));
    return torch::jit::readArchiveAndTensors("data", "", "", std::nullopt, std::nullopt, std::nullopt, reader);
  } catch (const std::exception&) {
    TORCH_CHECK_VALUE(false, "expected tensors as torch saves them");
  }
}

}  // namespace prdp
