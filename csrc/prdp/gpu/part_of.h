#pragma once
#include <ATen/ATen.h>

namespace prdp::gpu {

/// So many numbers of `memory`, a contiguous tensor, from this byte of it on: a tensor that shares it, without an
/// operation of torch.
inline at::Tensor part_of(const at::Tensor& memory, int64_t byte, int64_t count, at::ScalarType dtype) {
  auto part = at::detail::make_tensor<at::TensorImpl>(at::Storage(memory.storage()), memory.key_set(),
                                                      c10::scalarTypeToTypeMeta(dtype));
  part.unsafeGetTensorImpl()->set_storage_offset(byte / static_cast<int64_t>(c10::elementSize(dtype)));
  part.unsafeGetTensorImpl()->set_sizes_contiguous({count});
  return part;
}

}  // namespace prdp::gpu
