#include "prdp/gpu/operator_view.h"

namespace prdp::gpu {

std::string type_of(at::ScalarType dtype) { return dtype == at::kFloat ? "float" : "double"; }

std::string grid_of(at::IntArrayRef shape) {
  std::string text = "Grid<";
  for (size_t d = shape.size(); d < 3; ++d) text += "1, ";
  for (size_t d = 0; d < shape.size(); ++d) text += (d ? ", " : "") + std::to_string(shape[d]);
  return text + ">";
}

}  // namespace prdp::gpu
