#pragma once
#include <tuple>

#include "prdp/operators/operator.h"

namespace prdp {

/// A tensor as it was, whose version is counted: one that is not of inference mode.
class TensorFingerprint {
 public:
  TensorFingerprint() = default;
  explicit TensorFingerprint(const at::Tensor& t) : tensor_(t.getIntrusivePtr()), version_(t._version()) {}
  bool matches(const at::Tensor& t) const {
    return tensor_.lock().get() == t.unsafeGetTensorImpl() && version_ == t._version();
  }

 private:
  using Impl = c10::intrusive_ptr<at::TensorImpl, at::UndefinedTensorImpl>;
  c10::weak_intrusive_ptr<at::TensorImpl, at::UndefinedTensorImpl> tensor_{Impl()};
  uint32_t version_ = 0;
};

/// An operator by its numbers and tensors, as these were.
class SpecFingerprint {
 public:
  void store(const OperatorSpec& spec, at::ScalarType dtype) {
    tensors_.clear();
    for (const auto& t : spec.tensors) {
      if (t.is_inference()) return;  // its version is not counted
      tensors_.emplace_back(t);
    }
    kind_ = spec.kind;
    shape_ = spec.shape;
    parameters_ = spec.parameters;
    dtype_ = dtype;
  }
  bool matches(const OperatorSpec& spec, at::ScalarType dtype) const {
    if (tensors_.empty() || tensors_.size() != spec.tensors.size()) return false;
    for (size_t i = 0; i < tensors_.size(); ++i)
      if (!tensors_[i].matches(spec.tensors[i])) return false;
    return kind_ == spec.kind && shape_ == spec.shape && parameters_ == spec.parameters && dtype_ == dtype;
  }

 private:
  std::vector<TensorFingerprint> tensors_;
  std::string kind_;
  std::vector<int64_t> shape_;
  std::vector<double> parameters_;
  at::ScalarType dtype_{};
};

}  // namespace prdp
