#pragma once
#include "prdp/operators/operator.h"
#include "prdp/solvers/solver.h"
#include "prdp/solvers/status.h"

namespace prdp {

struct SolveResult {
  at::Tensor u;
  SolveInfo info;
};

/// A solve without derivatives. `caps` (int64, (batch,)) gives each sample its own max_iter.
struct SolveRequest {
  Method method;
  int64_t max_iter;
  double rtol;
  int64_t restart;
  std::optional<at::Tensor> caps{};
};

/// A u = b by the CPU loops, or by plain tensor operations where there are none for the operator or
/// the device. Samples do not influence each other; on the CPU loops not even in the last bit.
SolveResult solve(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// The same in plain tensor operations: the oracle for the CPU loops, and the way of other devices.
SolveResult solve_with_tensors(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// u after exactly `caps` iterations of each sample, recorded by autograd where b or the tensors of
/// `a` require it: the map whose derivative the unrolled mode takes.
at::Tensor solve_recorded(const Operator& a, const at::Tensor& b, const Solver& solver, const at::Tensor& caps);

/// Raises torch.linalg.LinAlgError, warns or does nothing about failed samples, naming them with
/// what happened. `role` is "linear_solve" or "adjoint solve".
void report_failures(const Operator& a, const at::Tensor& b, const SolveInfo& info,
                     OnFailure on_failure, const char* role);

/// Where warnings go; torch's own by default, which prints them on stderr.
using WarningSink = void (*)(const std::string& text);
void set_warning_sink(WarningSink sink);

}  // namespace prdp
