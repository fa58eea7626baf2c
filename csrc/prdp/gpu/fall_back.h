#pragma once
#include <string>
#include <vector>

namespace prdp::gpu {

/// Says why tensor operations take the place of a kernel that could not be made: once for each reason. With
/// PRDP_GPU=required it raises.
void fall_back(const std::string& reason);

/// The kernels that this process has made, in the order in which they were: "CG of Stencil<float, …>".
std::vector<std::string> kernels_made();
void note_made(const std::string& name);

}  // namespace prdp::gpu
