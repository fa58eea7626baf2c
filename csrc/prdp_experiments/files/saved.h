#pragma once
#include <ATen/core/Generator.h>

#include <limits>
#include <set>
#include <string>
#include <vector>

#include "prdp_experiments/files/tensor_map.h"

namespace prdp {

/// What the values of a tensor may be.
struct Range {
  double least = -std::numeric_limits<double>::infinity(), most = std::numeric_limits<double>::infinity();
  bool finite = true;          // neither Inf nor NaN
  bool unknown_is_nan = false;  // but NaN, where a value is not known
};

/// The tensors of a file while they are read. Each must be asked for, and must be as the reader says: every function
/// raises ValueError, which names the tensor, what it is and what was expected.
class Saved {
 public:
  explicit Saved(TensorMap tensors) : tensors_(std::move(tensors)) {}

  bool has(const std::string& name) const { return tensors_.contains(name); }
  /// The tensor of this name, dtype and sizes.
  const at::Tensor& take(const std::string& name, at::ScalarType dtype, at::IntArrayRef sizes, const Range& range = {});
  /// The same for `count` values in a row.
  template <class T>
  std::vector<T> list(const std::string& name, int64_t count, const Range& range = {}) {
    const auto values = take(name, c10::CppTypeToScalarType<T>::value, {count}, range).contiguous();
    return {values.template const_data_ptr<T>(), values.template const_data_ptr<T>() + count};
  }
  /// How many values in a row there are.
  int64_t length(const std::string& name) const;
  /// Puts a generator into the state of this name.
  void restore(const std::string& name, at::Generator generator);
  /// Raises ValueError for a tensor that nobody has asked for.
  void finish() const;

 private:
  const at::Tensor& found(const std::string& name) const;

  TensorMap tensors_;
  std::set<std::string> asked_;
};

}  // namespace prdp
