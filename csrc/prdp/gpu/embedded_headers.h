#pragma once
#include <vector>

namespace prdp::gpu {

/// A header that kernels include, by the name by which they do.
struct Source {
  const char *name, *text;
};
/// The text of the library that runs on a GPU, and stand-ins for the standard library's headers. Made by
/// cmake/embed_sources.cmake.
const std::vector<Source>& sources();

}  // namespace prdp::gpu
