#pragma once
#include <tuple>

#include "prdp/operators/operator.h"

namespace prdp {

/// An operator by its numbers and tensors, as these were.
class SpecFingerprint {
 public:
  void store(const OperatorSpec& spec, at::ScalarType dtype) {
    tensors_.clear();
    for (const auto& t : spec.tensors) {
      if (t.is_inference()) return;  // its version is not counted
      tensors_.emplace_back(t.getIntrusivePtr(), t._version());
    }
    kind_ = spec.kind;
    shape_ = spec.shape;
    parameters_ = spec.parameters;
    dtype_ = dtype;
  }
  bool matches(const OperatorSpec& spec, at::ScalarType dtype) const {
    if (tensors_.empty() || tensors_.size() != spec.tensors.size()) return false;
    for (size_t i = 0; i < tensors_.size(); ++i) {
      const auto& [tensor, version] = tensors_[i];
      const auto& t = spec.tensors[i];
      if (tensor.lock().get() != t.unsafeGetTensorImpl() || version != t._version()) return false;
    }
    return kind_ == spec.kind && shape_ == spec.shape && parameters_ == spec.parameters && dtype_ == dtype;
  }

 private:
  std::vector<std::pair<c10::weak_intrusive_ptr<at::TensorImpl, at::UndefinedTensorImpl>, uint32_t>> tensors_;
  std::string kind_;
  std::vector<int64_t> shape_;
  std::vector<double> parameters_;
  at::ScalarType dtype_{};
};

}  // namespace prdp
