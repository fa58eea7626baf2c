#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/autograd.h>
#include <torch/csrc/autograd/functions/basic_ops.h>
#include <torch/csrc/autograd/functions/utils.h>
#include <torch/library.h>

#include "prdp/autograd/node_pointer.h"
#include "prdp/autograd/packed_options.h"
#include "prdp/autograd/unrolled_vjp.h"
#include "prdp/error_text.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/with_autograd.h"

namespace prdp {

namespace {

constexpr const char* kSchema =
    "unrolled_jvp(Tensor[] tangents, Tensor b, Tensor iterations, Tensor status, Tensor residual, int[] "
    "needed, " PRDP_SOLVE_SCHEMA ") -> Tensor";
using Signature = WithSolve<at::Tensor(at::TensorList, const at::Tensor&, const at::Tensor&, const at::Tensor&,
                                       const at::Tensor&, at::IntArrayRef)>;

/// The product with the cotangent is linear in it; the transpose of that is the product with the tangents.
template <class... Args>
at::Tensor jvp_kernel(at::TensorList tangents, const at::Tensor& b, const at::Tensor& iterations,
                      const at::Tensor& status, const at::Tensor& residual, at::IntArrayRef needed, Args... args) {
  auto call = unpack_solve(args...);
  call.options.adjoint_log = 0;
  return with_autograd([&] {
    const auto leaf = [](const at::Tensor& t, bool wanted) { return t.detach().requires_grad_(wanted); };
    const Solved solved{
        leaf(b, needed[0]), {}, iterations, status, residual, call.x0.defined() ? call.x0.detach() : call.x0};
    auto& tensors = call.a.tensors;
    for (size_t i = 0; i < tensors.size(); ++i) tensors[i] = leaf(tensors[i], needed[i + 1]);
    const auto cotangent = at::ones_like(b).requires_grad_();  // any: the map is linear
    const auto found = unrolled_vjp_recorded(cotangent, solved, call.a, call.options, needed);
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

template <class... Others>
at::Tensor fake_kernel(at::TensorList, const at::Tensor& b, Others...) {
  return at::empty_symint(b.sym_sizes(), b.options());
}

/// The ops of first derivatives have none themselves: backward through them raises, and so does a tangent.
void refuse_second_derivatives(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  const std::string refusal = c10::str("linear_solve: ", in_language("backward=\"unrolled\"", "Backward::kUnrolled"),
                                       " has no second derivatives under torch.func or in forward mode; take ",
                                       in_language("backward=\"implicit\"", "Backward::kImplicit"),
                                       ", or torch.autograd.grad with create_graph=True");
  std::vector<at::Tensor> inputs;
  for (const auto& argument : torch::jit::last(*stack, op.schema().arguments().size())) {
    if (argument.isTensor()) inputs.push_back(argument.toTensor());
    if (argument.isTensorList())
      for (const at::Tensor& t : argument.toTensorVector()) inputs.push_back(t);
  }
  TORCH_CHECK_NOT_IMPLEMENTED(!any_tangent(inputs), refusal);
  const bool record = at::GradMode::is_enabled() && std::any_of(inputs.begin(), inputs.end(), [](const at::Tensor& t) {
                        return t.defined() && t.requires_grad();
                      });
  {
    const at::AutoDispatchBelowADInplaceOrView below;
    op.callBoxed(stack);
  }
  if (!record) return;
  const auto node =
      make_node<torch::autograd::Error>(refusal, torch::autograd::collect_next_edges(at::TensorList(inputs)));
  const auto& derivatives = torch::jit::peek(*stack, 0, op.schema().returns().size());  // the first result
  if (derivatives.isTensor()) torch::autograd::set_history(derivatives.toTensor(), node);
  else torch::autograd::set_history(derivatives.toTensorVector(), node);
}

}  // namespace

at::Tensor unrolled_jvp(at::TensorList tangents, const Solved& solved, const OperatorSpec& a,
                        const SolveOptions& options, at::IntArrayRef needed) {
  static const auto op = c10::Dispatcher::singleton().findSchemaOrThrow("prdp::unrolled_jvp", "").typed<Signature>();
  return call_with_solve(op, a, solved.x0, options, tangents, solved.b, solved.iterations, solved.status,
                         solved.residual, needed);
}

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def(kSchema, {at::Tag::pt2_compliant_tag}); }
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) { m.impl("unrolled_jvp", static_cast<Signature*>(jvp_kernel)); }
TORCH_LIBRARY_IMPL(prdp, Meta, m) { m.impl("unrolled_jvp", static_cast<Signature*>(fake_kernel)); }
TORCH_LIBRARY_IMPL(prdp, Autograd, m) {
  for (const char* op : {"unrolled_vjp", "unrolled_jvp"})
    m.impl(op, torch::CppFunction::makeFromBoxedFunction<&refuse_second_derivatives>());
}

}  // namespace prdp
