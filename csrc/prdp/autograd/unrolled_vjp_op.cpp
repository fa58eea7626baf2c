#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/autograd.h>
#include <torch/library.h>

#include <algorithm>
#include <limits>

#include "prdp/autograd/op_results.h"
#include "prdp/autograd/packed_options.h"
#include "prdp/autograd/unrolled_samples.h"
#include "prdp/autograd/unrolled_vjp.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/solve.h"
#include "prdp/solvers/solve_recorded.h"

namespace prdp {

namespace {

constexpr const char* kSchema =
    "unrolled_vjp(Tensor cotangent, Tensor b, Tensor iterations, Tensor status, Tensor residual, "
    "int[] needed, " PRDP_SOLVE_SCHEMA ") -> (Tensor[] gradients, " PRDP_REPORT_SCHEMA ")";
using Outputs = std::tuple<std::vector<at::Tensor>, at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor>;
using Signature = WithSolve<Outputs(const at::Tensor&, const at::Tensor&, const at::Tensor&, const at::Tensor&,
                                    const at::Tensor&, at::IntArrayRef)>;

/// The iterations, run again and taken back.
UnrolledVjp run_iterations_back(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                                at::IntArrayRef needed) {
  const auto method = solve.solver.method;
  const bool for_b_alone = std::count(needed.begin(), needed.end(), 1) == 1 && needed[0] == 1;
  if (traits(method).is_polynomial && for_b_alone) {
    // K iterations from zero are u = p(M⁻¹A) M⁻¹ b, M being the diagonal or a cycle; transposed, K iterations with Aᵀ
    // and M⁻ᵀ.
    auto transpose = solve.a;
    transpose.transposed = !transpose.transposed;
    const Solver transposed{method, 0, 0.0, solve.solver.restart, solve.solver.preconditioner.transposed()};
    const SolveRequest request{transposed, solve.iterations, /*guarded=*/false};
    const auto [b_bar, info] = prdp::solve(*make_operator(transpose), cotangent, request);
    UnrolledVjp found{std::vector<at::Tensor>(needed.size()), info.operator_applications};
    found.gradients[0] = b_bar;
    return found;
  }
  if (can_use_tape(*make_operator(solve.a), solve, b)) return tape_vjp(cotangent, b, solve, needed);
  return replay_vjp(cotangent, b, solve, needed);
}

/// The iterations, recorded all at once, and their derivative, recorded too.
UnrolledVjp record_iterations(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                              at::IntArrayRef needed) {
  // Partial derivatives: b and the tensors may be one tensor, or depend on each other further back.
  const auto rhs = needed[0] && !b.requires_grad() ? b.detach().requires_grad_() : at::alias(b);
  auto a = solve.a;
  for (auto& t : a.tensors) t = at::alias(t);
  const auto [u, applications] = solve_recorded(*make_operator(a), rhs, solve.x0, solve.solver, solve.iterations);
  std::vector<at::Tensor> inputs;
  for (size_t i = 0; i < needed.size(); ++i)
    if (needed[i]) inputs.push_back(i == 0 ? rhs : a.tensors[i - 1]);
  const auto gradients = torch::autograd::grad({u}, inputs, {cotangent}, /*retain_graph=*/true,
                                               /*create_graph=*/true, /*allow_unused=*/true);
  return {in_places(gradients, needed), 2 * applications};  // as many again on the way back
}

template <class... Args>
Outputs vjp_kernel(const at::Tensor& cotangent, const at::Tensor& b, const at::Tensor& iterations,
                   const at::Tensor& status, const at::Tensor& residual, at::IntArrayRef needed, Args... args) {
  const at::NoGradGuard no_grad;
  auto [a, options, x0] = unpack_solve(args...);
  for (auto& t : a.tensors) t = t.detach();
  make_operator(a)->check_parameters(checks_of(options.on_failure));
  const auto found = vjp_of_samples(cotangent, {b.detach(), {}, iterations, status, residual, x0}, a, options, needed,
                                    run_iterations_back, linear_solve_unrecorded);
  const auto gradients = only_needed(found.gradients, needed);
  const auto& info = found.info;
  // -1 crosses the op for no residual: torch's checks of ops compare outputs, and NaN equals nothing.
  const auto residual_or_not = info.residual.masked_fill(info.residual.isnan(), -1.0);
  return {gradients, info.iterations, residual_or_not, info.status, info.operator_applications, info.floor};
}

template <class... Others>
Outputs fake_kernel(const at::Tensor&, const at::Tensor& b, const at::Tensor&, const at::Tensor&, const at::Tensor&,
                    at::IntArrayRef needed, at::TensorList tensors, Others...) {
  const auto gradients = empty_gradients(b, b.sym_sizes(), tensors, needed);
  const auto info = empty_info(b, {b.sym_size(0)});
  return {gradients, info.iterations, info.residual, info.status, info.operator_applications, info.floor};
}

}  // namespace

SolveVjp unrolled_vjp(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                      const SolveOptions& options, at::IntArrayRef needed) {
  static const auto op = c10::Dispatcher::singleton().findSchemaOrThrow("prdp::unrolled_vjp", "").typed<Signature>();
  const auto [gradients, iterations, residual, status, applications, floor] = call_with_solve(
      op, a, solved.x0, options, cotangent, solved.b, solved.iterations, solved.status, solved.residual, needed);
  const auto or_nan = residual.masked_fill(residual.lt(0), std::numeric_limits<double>::quiet_NaN());
  return {in_places(gradients, needed), {iterations, or_nan, status, applications, floor}};
}

SolveVjp unrolled_vjp_recorded(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                               const SolveOptions& options, at::IntArrayRef needed) {
  const at::AutoGradMode record(true);
  return vjp_of_samples(cotangent, solved, a, options, needed, record_iterations, linear_solve);
}

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def(kSchema, {at::Tag::pt2_compliant_tag}); }
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) { m.impl("unrolled_vjp", static_cast<Signature*>(vjp_kernel)); }
TORCH_LIBRARY_IMPL(prdp, Meta, m) { m.impl("unrolled_vjp", static_cast<Signature*>(fake_kernel)); }

}  // namespace prdp
