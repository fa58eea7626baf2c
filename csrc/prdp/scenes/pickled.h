#pragma once
#include <ATen/core/ivalue.h>

#include <string_view>

namespace prdp {

/// The tensors, texts and lists of them in the bytes of a file that torch.save or torch::jit::pickle_save has written.
/// This reader knows no classes and has no interpreter, unlike torch::jit::load and torch::serialize. Raises ValueError
/// for other bytes.
c10::IValue read_pickled(std::string_view bytes);

}  // namespace prdp
