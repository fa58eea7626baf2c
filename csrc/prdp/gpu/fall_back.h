#pragma once
#include <string>
#include <vector>

#include "prdp/gpu/runtime.h"

namespace prdp::gpu {

/// Says why tensor operations take the place of a kernel that could not be made: once for each reason. With
/// PRDP_GPU=required it raises.
void fall_back(const std::string& reason);
/// f(), or nothing where it raises Unavailable, after fall_back().
template <class F>
auto or_fall_back(const F& f) -> decltype(f()) {
  try {
    return f();
  } catch (const Unavailable& reason) {
    fall_back(reason.what());
    return {};
  }
}

/// The kernels that this process has made, in the order in which they were: "CG of Stencil<float, …>".
std::vector<std::string> kernels_made();
void note_made(const std::string& name);

}  // namespace prdp::gpu
