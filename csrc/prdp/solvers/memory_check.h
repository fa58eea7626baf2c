#pragma once
#include <cstdint>

#include "prdp/solvers/solver.h"

namespace prdp {

/// Of this machine, in bytes.
double physical_memory();

/// Raises ValueError, with the memory that it would take, for a restart of GMRES whose basis of vectors like those of
/// the right-hand side b does not fit into the machine. On other devices torch says so.
void check_memory(const SolveOptions& options, const at::Tensor& b, bool all_samples_at_once = false);

}  // namespace prdp
