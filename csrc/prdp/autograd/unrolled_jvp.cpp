#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/autograd.h>
#include <torch/csrc/autograd/functions/basic_ops.h>
#include <torch/csrc/autograd/functions/utils.h>
#include <torch/library.h>

#include "prdp/operators/disguises.h"
#include "prdp/autograd/unrolled_vjp.h"

namespace prdp {

namespace {

constexpr const char* kSchema =
    "unrolled_jvp(Tensor[] tangents, Tensor b, Tensor[] tensors, int[] needed, str kind, int[] shape, "
    "float[] parameters, bool transposed, str solver, SymInt max_iter, float rtol, int restart, "
    "Tensor iterations, Tensor status) -> Tensor";

/// The product with the cotangent is linear in it; the transpose of that is the product with the tangents.
at::Tensor jvp_kernel(at::TensorList tangents, const at::Tensor& b, at::TensorList tensors,
                      at::IntArrayRef needed, c10::string_view kind, at::IntArrayRef shape,
                      at::ArrayRef<double> parameters, bool transposed, c10::string_view solver,
                      c10::SymInt max_iter, double rtol, int64_t restart, const at::Tensor& iterations,
                      const at::Tensor& status) {
  UnrolledSolve solve{{std::string(kind), shape.vec(), parameters.vec(), {}, transposed},
                      {method_from_name(solver), max_iter, rtol, restart},
                      iterations,
                      status};
  return with_autograd([&] {
    const auto leaf = [](const at::Tensor& t, bool wanted) { return t.detach().requires_grad_(wanted); };
    const auto rhs = leaf(b, needed[0]);
    for (size_t i = 0; i < tensors.size(); ++i) solve.a.tensors.push_back(leaf(tensors[i], needed[i + 1]));
    const auto cotangent = at::ones_like(b).requires_grad_();  // any: the map is linear
    const auto found = unrolled_vjp_recorded(cotangent, rhs, solve, needed, /*log=*/0);
    std::vector<at::Tensor> gradients, along;
    for (size_t i = 0, next = 0; i < needed.size(); ++i) {
      if (!needed[i]) continue;
      const auto& tangent = tangents[next++];
      const auto& gradient = found.gradients[i];
      if (!gradient.defined() || !gradient.requires_grad()) continue;
      gradients.push_back(gradient);
      along.push_back(tangent.detach());
    }
    if (gradients.empty()) return at::zeros_like(b);
    const auto product = torch::autograd::grad(gradients, {cotangent}, along, false, false, true)[0];
    return product.defined() ? product.contiguous() : at::zeros_like(b);
  });
}

at::Tensor fake_kernel(at::TensorList, const at::Tensor& b, at::TensorList, at::IntArrayRef, c10::string_view,
                       at::IntArrayRef, at::ArrayRef<double>, bool, c10::string_view, c10::SymInt, double,
                       int64_t, const at::Tensor&, const at::Tensor&) {
  return at::empty_symint(b.sym_sizes(), b.options());
}

/// The ops of first derivatives have none themselves: backward through them raises, and so does a tangent.
void refuse_second_derivatives(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  constexpr const char* kRefusal =
      "linear_solve: backward=\"unrolled\" has no second derivatives under torch.func or in forward mode; "
      "take backward=\"implicit\", or torch.autograd.grad with create_graph=True";
  std::vector<at::Tensor> inputs;
  for (const auto& argument : torch::jit::last(*stack, op.schema().arguments().size())) {
    if (argument.isTensor()) inputs.push_back(argument.toTensor());
    if (argument.isTensorList())
      for (const at::Tensor& t : argument.toTensorVector()) inputs.push_back(t);
  }
  TORCH_CHECK_NOT_IMPLEMENTED(!any_tangent(inputs), kRefusal);
  const bool record =
      at::GradMode::is_enabled() && std::any_of(inputs.begin(), inputs.end(), [](const at::Tensor& t) {
        return t.defined() && t.requires_grad();
      });
  {
    const at::AutoDispatchBelowADInplaceOrView below;
    op.callBoxed(stack);
  }
  if (!record) return;
  const auto refusal = c10::make_intrusive<torch::autograd::Error>(
      kRefusal, torch::autograd::collect_next_edges(at::TensorList(inputs)));
  const auto& derivatives = torch::jit::peek(*stack, 0, op.schema().returns().size());  // the first result
  if (derivatives.isTensor()) torch::autograd::set_history(derivatives.toTensor(), refusal);
  else torch::autograd::set_history(derivatives.toTensorVector(), refusal);
}

}  // namespace

at::Tensor unrolled_jvp(at::TensorList tangents, const at::Tensor& b, const UnrolledSolve& solve,
                        at::IntArrayRef needed) {
  static const auto op = c10::Dispatcher::singleton()
                             .findSchemaOrThrow("prdp::unrolled_jvp", "")
                             .typed<decltype(jvp_kernel)>();
  const auto& a = solve.a;
  return op.call(tangents, b, a.tensors, needed, a.kind, a.shape, a.parameters, a.transposed,
                 name(solve.solver.method), solve.solver.max_iter, solve.solver.rtol, solve.solver.restart,
                 solve.iterations, solve.status);
}

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def(kSchema, {at::Tag::pt2_compliant_tag}); }
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) { m.impl("unrolled_jvp", jvp_kernel); }
TORCH_LIBRARY_IMPL(prdp, Meta, m) { m.impl("unrolled_jvp", fake_kernel); }
TORCH_LIBRARY_IMPL(prdp, Autograd, m) {
  for (const char* op : {"unrolled_vjp", "unrolled_jvp"})
    m.impl(op, torch::CppFunction::makeFromBoxedFunction<&refuse_second_derivatives>());
}

}  // namespace prdp
