#include "prdp/autograd/unrolled_vjp.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/autograd.h>
#include <torch/library.h>

#include <array>

#include "prdp/autograd/linear_solve.h"
#include "prdp/solvers/solve.h"

namespace prdp {

namespace {

constexpr const char* kSchema =
    "unrolled_vjp(Tensor cotangent, Tensor b, Tensor[] tensors, int[] needed, str kind, "
    "int[] shape, float[] parameters, bool transposed, str solver, SymInt max_iter, float rtol, int restart, "
    "Tensor iterations, Tensor status) -> Tensor[]";

/// b = 0 is solved in no iterations, yet the map has a derivative there: A⁻ᵀ by the same method and
/// budget, which for linear methods is the derivative of all max_iter iterations. Adds it to b̄.
void add_derivative_at_zero(std::vector<at::Tensor>& gradients, const at::Tensor& cotangent,
                            const UnrolledSolve& solve, at::IntArrayRef needed) {
  const auto at_zero = solve.iterations.eq(0).logical_and(
      solve.status.eq(static_cast<int64_t>(SolveStatus::kConverged)));
  if (!needed[0] || !at_zero.any().item<bool>()) return;
  auto rows = at_zero;
  while (rows.dim() < cotangent.dim()) rows = rows.unsqueeze(-1);
  auto a = solve.a;
  a.transposed = !a.transposed;
  SolveOptions options{solve.solver, Backward::kImplicit};
  options.on_failure = OnFailure::kReturn;
  gradients[0] = gradients[0] + linear_solve(a, cotangent * rows, options).u;
}

/// The gradients of the recorded iterations for the inputs that `needed` marks.
std::vector<at::Tensor> differentiate(const at::Tensor& cotangent, const at::Tensor& b,
                                      const UnrolledSolve& solve, at::IntArrayRef needed,
                                      bool create_graph) {
  // The op may run where autograd is switched off, inside a compiled graph for one; here it is wanted.
  const auto keys = c10::impl::tls_local_dispatch_key_set();
  const c10::impl::ForceDispatchKeyGuard with_autograd(
      keys.included_, keys.excluded_ - c10::autograd_dispatch_keyset_with_ADInplaceOrView);
  const at::AutoGradMode record(true);
  const auto u = solve_recorded(*make_operator(solve.a), b, solve.solver, solve.iterations);
  std::vector<at::Tensor> inputs;
  if (needed[0]) inputs.push_back(b);
  for (size_t i = 0; i < solve.a.tensors.size(); ++i)
    if (needed[i + 1]) inputs.push_back(solve.a.tensors[i]);
  std::vector<at::Tensor> gradients(inputs.size());
  if (u.requires_grad())  // not where no sample took an iteration
    gradients = torch::autograd::grad({u}, inputs, {cotangent}, create_graph, create_graph,
                                      /*allow_unused=*/true);
  for (size_t i = 0; i < inputs.size(); ++i)
    if (!gradients[i].defined()) gradients[i] = at::zeros_like(inputs[i]);
  add_derivative_at_zero(gradients, cotangent, solve, needed);
  return gradients;
}

std::vector<at::Tensor> vjp_kernel(const at::Tensor& cotangent, const at::Tensor& b,
                                   at::TensorList tensors, at::IntArrayRef needed,
                                   c10::string_view kind, at::IntArrayRef shape,
                                   at::ArrayRef<double> parameters, bool transposed,
                                   c10::string_view solver, c10::SymInt max_iter, double rtol,
                                   int64_t restart, const at::Tensor& iterations, const at::Tensor& status) {
  UnrolledSolve unrolled{{std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), transposed},
                         {method_from_name(solver), max_iter, rtol, restart},
                         iterations,
                         status};
  const bool for_b_alone = std::count(needed.begin(), needed.end(), 1) == 1 && needed[0] == 1;
  const auto method = unrolled.solver.method;
  if ((method == Method::kJacobi || method == Method::kChebyshev) && for_b_alone) {
    // K sweeps from zero are u = p(I - D⁻¹A) D⁻¹ b with a polynomial p; transposed, that is K sweeps with Aᵀ.
    auto transpose = unrolled.a;
    transpose.transposed = !transposed;
    const SolveRequest request{method, 0, 0.0, restart, iterations};
    std::vector<at::Tensor> gradients{prdp::solve(*make_operator(transpose), cotangent, request).u};
    add_derivative_at_zero(gradients, cotangent, unrolled, needed);
    return gradients;
  }
  std::vector<at::Tensor> leaves;
  for (size_t i = 0; i < tensors.size(); ++i)
    leaves.push_back(needed[i + 1] ? tensors[i].detach().requires_grad_() : tensors[i].detach());
  unrolled.a.tensors = leaves;
  return differentiate(cotangent, b.detach().requires_grad_(needed[0] == 1), unrolled, needed, false);
}

std::vector<at::Tensor> fake_kernel(const at::Tensor&, const at::Tensor& b, at::TensorList tensors,
                                    at::IntArrayRef needed, c10::string_view, at::IntArrayRef,
                                    at::ArrayRef<double>, bool, c10::string_view, c10::SymInt, double,
                                    int64_t, const at::Tensor&, const at::Tensor&) {
  std::vector<at::Tensor> gradients;
  if (needed[0]) gradients.push_back(at::empty_symint(b.sym_sizes(), b.options()));
  for (size_t i = 0; i < tensors.size(); ++i)
    if (needed[i + 1]) gradients.push_back(at::empty_symint(tensors[i].sym_sizes(), tensors[i].options()));
  return gradients;
}

}  // namespace

std::vector<at::Tensor> unrolled_vjp(const at::Tensor& cotangent, const at::Tensor& b,
                                     const UnrolledSolve& solve, at::IntArrayRef needed) {
  static const auto op = c10::Dispatcher::singleton()
                             .findSchemaOrThrow("prdp::unrolled_vjp", "")
                             .typed<decltype(vjp_kernel)>();
  const auto& a = solve.a;
  return op.call(cotangent, b, a.tensors, needed, a.kind, a.shape, a.parameters, a.transposed,
                 name(solve.solver.method), solve.solver.max_iter, solve.solver.rtol,
                 solve.solver.restart, solve.iterations, solve.status);
}

std::vector<at::Tensor> unrolled_vjp_recorded(const at::Tensor& cotangent, const at::Tensor& b,
                                              const UnrolledSolve& solve,
                                              at::IntArrayRef needed) {
  return differentiate(cotangent, b, solve, needed, /*create_graph=*/true);
}

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def(kSchema, {at::Tag::pt2_compliant_tag}); }
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) { m.impl("unrolled_vjp", vjp_kernel); }
TORCH_LIBRARY_IMPL(prdp, Meta, m) { m.impl("unrolled_vjp", fake_kernel); }

}  // namespace prdp
