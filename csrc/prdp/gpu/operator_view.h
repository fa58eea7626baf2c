#pragma once
#include <ATen/ATen.h>

#include <optional>
#include <string>
#include <vector>

#include "prdp/gpu/device/arguments.h"

namespace prdp::gpu {

/// An operator as a kernel takes it: a type of device/views.h, upwind.h or diffusion.h, and the tensors and numbers of
/// it.
struct OperatorView {
  std::string type;  // "Laplacian<float, Grid<1, 64, 64>>"
  /// Contiguous, with one sample or as many as the vectors, or one axis, for all of them; undefined: there is none.
  std::vector<at::Tensor> tensors{};
  std::vector<double> numbers{};
  /// Orthonormal vectors of one field, (count, length), or (batch or 1, count, length) with zeros where a sample has
  /// fewer; without entries: the constant one; undefined: no null space.
  at::Tensor null_space{}, left_null_space{};
  int64_t null_field = -1;  // the one channel that these belong to; -1: each has its own
  bool needs_projection = false;       // Operator::needs_projection()
};

/// Its tensors and numbers as a kernel takes them.
OperatorArguments arguments_of(const OperatorView& a);
/// Whether all samples have the same A.
bool is_shared(const OperatorView& a);

/// "float" or "double".
std::string type_of(at::ScalarType dtype);
/// "Grid<1, 64, 64>" of up to three extents.
std::string grid_of(at::IntArrayRef shape);

}  // namespace prdp::gpu
