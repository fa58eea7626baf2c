#pragma once
#include <string>
#include <string_view>
#include <vector>

/// What the library reads from outside, given any bytes. Each function returns whatever the bytes are, unless there is
/// a fault in the library: it lets the library's errors of arguments pass, and no others.
namespace prdp_fuzz {

struct Target {
  const char* name;
  void (*run)(std::string_view);
};
/// "scene": the text of a scene. "files": a record, a checkpoint, cached data, weights. "operators": the flat
/// description of a matrix or a stencil, a right-hand side and the options of a solve.
const std::vector<Target>& targets();

}  // namespace prdp_fuzz
