#pragma once
#include <torch/csrc/utils/pybind.h>

#include "prdp/solvers/solve.h"

/// What the bindings of solves share.

/// The options with the limit and the log of one call.
inline prdp::SolveOptions with(prdp::SolveOptions options, int64_t max_iter, int64_t adjoint_log) {
  options.solver.max_iter = max_iter;
  options.adjoint_log = adjoint_log;
  return options;
}

inline pybind11::tuple as_tuple(const prdp::SolveInfo& info) {
  return pybind11::make_tuple(info.iterations, info.residual, info.status, info.operator_applications, info.floor);
}

/// u, and behind it the parts of the report.
inline pybind11::tuple as_tuple(const prdp::SolveResult& result) {
  const auto& [u, info] = result;
  return pybind11::make_tuple(u, info.iterations, info.residual, info.status, info.operator_applications, info.floor);
}
