#pragma once
#include "prdp/operators/operator.h"
#include "prdp/operators/registered_products.h"
#include "prdp/solvers/solver.h"

/// What is said of solves: errors for failed samples, and warnings where a result may mislead.
namespace prdp {

/// The solve that a report is about.
struct SolveRole {
  const OperatorSpec& a;  // transposed for an adjoint solve
  const Solver& solver;
  bool adjoint;
  at::Tensor x0{};
  bool unrolled = false;  // the derivative of iterations, in place of an adjoint solve
};

/// Raises c10::LinAlgError, warns or does nothing about failed samples, as `on_failure` says. The message names the
/// samples, the operator, the cause and a remedy (failure_messages.h). If none failed, it warns once of samples that
/// ended far from rtol. kReturn and kZeroGrad only warn of cotangents that are not finite, where the status is on the
/// CPU.
void report_failures(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveInfo& info,
                     OnFailure on_failure);

/// Says once that zeros take the place of the gradients of `lost` samples, whose cotangent is not finite: a loss scaler
/// waits for those, and skips no update. `who` begins the sentence.
void warn_of_lost_cotangents(const std::string& who, int64_t lost, int64_t batch);

/// Says once that an unrolled gradient of A takes the cycles of multigrid for constants.
void warn_of_constant_cycles();

/// Says once that the tensors of a preconditioner get no gradient.
void warn_of_constant_preconditioner();

/// Warns that ⟨λ, b⟩ and ⟨u, ū⟩ of a sample differ, so that a Function's adjoint solve was made with another A: once
/// for this `code`.
void warn_of_another_transpose(FunctionCode& code, int64_t sample, double of_solve, double of_adjoint);

/// Warns that ‖b - A u‖/‖b‖ of a sample is not what it was when a Function was solved: once for this `code`.
void warn_of_another_product(FunctionCode& code, int64_t sample, double now, double before);

}  // namespace prdp
