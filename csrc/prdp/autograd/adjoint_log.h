#pragma once
#include <cstdint>
#include <optional>

#include "prdp/solvers/solver.h"

/// Logs for the reports of adjoint solves. A backward pass cannot return its report to a caller. So a caller opens a
/// log, passes its number to the solve, and reads the log after the backward pass.
namespace prdp::adjoint_log {

/// A fresh number, never 0. The kSteps numbers that follow are its own as well: those of the steps of a rollout, where
/// somebody can hold a single log alone, as a compiled graph does.
int64_t open();
inline constexpr int64_t kSteps = 1 << 24;
void close(int64_t log);

/// The report of the last adjoint solve; nothing before the first backward pass, and for unknown numbers.
std::optional<SolveInfo> read(int64_t log);
void write(const c10::SymInt& log, const SolveInfo& info);

}  // namespace prdp::adjoint_log
