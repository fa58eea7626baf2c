#include "prdp/steppers/equation.h"

#include <c10/util/safe_numerics.h>
#include <torch/library.h>

#include <algorithm>

#include "prdp/autograd/detach_failed.h"
#include "prdp/autograd/op_results.h"
#include "prdp/operators/kinds.h"
#include "prdp/steppers/equation_kinds.h"
#include "prdp/steppers/packed_equation.h"
#include "prdp/steppers/stepper.h"

namespace prdp {

namespace {

/// A state of the equation in which nothing moves.
at::Tensor state_at_rest(const Equation& equation) {
  const int64_t channels = equation_kind(equation.kind).channels;
  std::vector<int64_t> sizes{1, channels == kPerAxis ? static_cast<int64_t>(equation.shape.size()) : channels};
  // A negative extent is left for the operator to refuse.
  for (const int64_t n : equation.shape) sizes.push_back(std::max<int64_t>(n, 0));
  uint64_t numbers = 0;
  TORCH_CHECK_VALUE(!c10::safe_multiplies_u64(sizes, &numbers) && numbers < uint64_t{1} << 63,
                    operator_kind(equation.kind).title, ": a state of shape ", at::IntArrayRef(equation.shape),
                    " has more than 2**63 numbers");
  return at::zeros({1}).expand(sizes);  // of any size in the memory of one number
}

}  // namespace

void Equation::check_picard_steps() const {
  TORCH_CHECK_VALUE(picard_steps >= 1, operator_kind(kind).title, ": picard_steps must be >= 1, got ", picard_steps);
}

void Equation::check() const {
  check_picard_steps();
  make_operator(equation_operator(*this, state_at_rest(*this)))->check_parameters();
}

OperatorSpec equation_operator(const Equation& equation, const at::Tensor& u) {
  auto tensors = equation.tensors;
  if (equation_kind(equation.kind).linearised) tensors.insert(tensors.begin(), u);  // the winds
  return {equation.kind, equation.shape, equation.parameters, tensors};
}

at::Tensor equation_rhs(const Equation& equation, const at::Tensor& u) {
  const auto rhs = equation_kind(equation.kind).rhs;
  return rhs ? rhs(equation, u) : u;
}

at::Tensor equation_rhs_transposed(const Equation& equation, const at::Tensor& bar) {
  const auto transposed = equation_kind(equation.kind).rhs_transposed;
  return transposed ? transposed(equation, bar) : bar;
}

SolveInfo joined(const SolveInfo& before, const SolveInfo& last) {
  const auto worst = at::minimum(before.status, last.status);  // the least is the worst
  return {before.iterations + last.iterations, last.residual, worst,
          before.operator_applications + last.operator_applications, floor_of(last.floor, worst)};
}

SolveResult step(const Equation& equation, const at::Tensor& u, const SolveOptions& options) {
  equation.check_picard_steps();
  const auto b = equation_rhs(equation, u);
  const auto solve_about = [&](const at::Tensor& state) {
    return linear_solve(equation_operator(equation, state), b, options, start_of_step(options, state));
  };
  auto result = solve_about(u);
  for (int64_t k = 1; k < equation.picard_steps; ++k) {
    const auto before = std::move(result.info);
    result = solve_about(result.u);
    result.info = joined(before, result.info);
  }
  if (equation.picard_steps > 1 && options.on_failure == OnFailure::kZeroGrad)
    result.u = detach_failed(result.u, result.info.status);  // whichever of its solves failed
  return result;
}

namespace {

template <class... Args>
SolveOutputs step_kernel(const at::Tensor& u, Args... args) {
  const auto kernel = [&](const Equation& equation, const auto&... packed) {
    return outputs_of(step(equation, u, unpack(packed...)));
  };
  return with_equation(kernel, args...);
}
using StepSignature = WithOptions<WithEquation<SolveOutputs(const at::Tensor&)>>;

at::Tensor rhs_op(const at::Tensor& u, c10::string_view kind, at::IntArrayRef shape, at::ArrayRef<double> parameters) {
  return equation_rhs({std::string(kind), shape.vec(), parameters.vec(), {}}, u);
}

template <class... Args>
void check_equation_op(Args... args) {
  with_equation([](const Equation& equation) { equation.check(); }, args...);
}
using CheckSignature = WithEquation<void()>;

}  // namespace

TORCH_LIBRARY_FRAGMENT(prdp, m) {
  m.def("step(Tensor u, " PRDP_EQUATION_SCHEMA ", " PRDP_OPTIONS_SCHEMA ") -> (Tensor u_next, " PRDP_REPORT_SCHEMA ")",
        static_cast<StepSignature*>(step_kernel));
  m.def("rhs(Tensor u, str kind, int[] shape, float[] parameters) -> Tensor", rhs_op);
  m.def("check_equation(" PRDP_EQUATION_SCHEMA ") -> ()", static_cast<CheckSignature*>(check_equation_op));
}

// torch.func.vmap goes through what they are made of.
TORCH_LIBRARY_IMPL(prdp, FuncTorchBatchedDecomposition, m) {
  m.impl("step", static_cast<StepSignature*>(step_kernel));
  m.impl("rhs", rhs_op);
  m.impl("check_equation", static_cast<CheckSignature*>(check_equation_op));
}

}  // namespace prdp
