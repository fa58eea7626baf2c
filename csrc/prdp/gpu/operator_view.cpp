#include "prdp/gpu/operator_view.h"

#include <algorithm>

namespace prdp::gpu {

namespace {

bool is_of_all(const at::Tensor& t) { return t.dim() == 1 || t.size(0) == 1; }

}  // namespace

OperatorArguments arguments_of(const OperatorView& a) {
  OperatorArguments arguments{};
  for (size_t i = 0; i < a.tensors.size(); ++i) {
    if (!a.tensors[i].defined()) continue;
    arguments.tensors[i] = a.tensors[i].const_data_ptr();
    arguments.sample_strides[i] = is_of_all(a.tensors[i]) ? 0 : a.tensors[i].stride(0);
  }
  std::copy(a.numbers.begin(), a.numbers.end(), arguments.numbers);
  return arguments;
}

bool is_shared(const OperatorView& a) {
  return std::all_of(a.tensors.begin(), a.tensors.end(),
                     [](const at::Tensor& t) { return !t.defined() || is_of_all(t); });
}

std::string type_of(at::ScalarType dtype) { return dtype == at::kFloat ? "float" : "double"; }

std::string grid_of(at::IntArrayRef shape) {
  std::string text = "Grid<";
  for (size_t d = shape.size(); d < 3; ++d) text += "1, ";
  for (size_t d = 0; d < shape.size(); ++d) text += (d ? ", " : "") + std::to_string(shape[d]);
  return text + ">";
}

}  // namespace prdp::gpu
