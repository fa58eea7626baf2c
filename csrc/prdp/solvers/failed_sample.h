#pragma once
#include "prdp/operators/kinds.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/report_failures.h"

namespace prdp {

/// One sample of a solve, which failed or ended far from its tolerance: what messages about it are made of.
struct FailedSample {
  const SolveRole& role;
  const Operator& a;
  const at::Tensor& b;
  int64_t index;

  const Solver& solver() const { return role.solver; }
  const MethodTraits& method() const { return traits(role.solver.method); }
  const Preconditioner& preconditioner() const { return role.solver.preconditioner; }
  bool is_diffusion() const { return std::string_view(operator_kind(role.a.kind).title) == "Diffusion"; }
  bool has_pressure() const { return operator_kind(role.a.kind).has_pressure; }

  bool is_single() const { return b.scalar_type() == at::kFloat; }
  const char* precision() const { return is_single() ? "float32" : "float64"; }

  /// This sample of a batch of vectors, or of what all samples share.
  at::Tensor of(const at::Tensor& v) const { return v.expand_as(b).select(0, index); }
  /// A times a vector of ones.
  at::Tensor row_sums() const { return of(a.apply(at::ones_like(b))); }
};

inline double norm_of(const at::Tensor& v) { return v.to(at::kDouble).norm().item<double>(); }

}  // namespace prdp
