#pragma once
#include <cstdint>
#include <optional>

#include "prdp/solvers/solver.h"

/// Where adjoint solves leave their SolveInfo. A backward pass has no caller to return it to; so
/// whoever wants it opens a log, passes its number with the solve and reads it afterwards.
namespace prdp::adjoint_log {

/// A fresh number, never 0.
int64_t open();
void close(int64_t log);

/// The last adjoint solve's; nothing before the first backward pass. Unknown numbers hold nothing.
std::optional<SolveInfo> read(int64_t log);
void write(int64_t log, const SolveInfo& info);

}  // namespace prdp::adjoint_log
