#include <ATen/core/grad_mode.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/library.h>

#include <algorithm>

#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"
#include "prdp/operators/with_autograd.h"

/// The operators as torch ops, made of plain tensor operations, so that autograd goes through them; without it, of the
/// CPU loops.
namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

at::Tensor product(const OperatorSpec& a, const at::Tensor& v);

OperatorSpec spec(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape, at::ArrayRef<double> parameters,
                  bool transposed = false) {
  return {std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), transposed};
}

/// A v by the loops, as one node: recorded in tensor operations it would take ten times as long, and keep what each of
/// them does.
class Product : public torch::autograd::Function<Product> {
 public:
  static at::Tensor forward(AutogradContext* ctx, const at::Tensor& v, at::TensorList tensors, const OperatorSpec& a) {
    variable_list saved{any_requires_grad(tensors) ? v : at::Tensor()};
    saved.insert(saved.end(), tensors.begin(), tensors.end());
    ctx->save_for_backward(std::move(saved));
    ctx->saved_data["kind"] = a.kind;
    ctx->saved_data["shape"] = a.shape;
    ctx->saved_data["parameters"] = a.parameters;
    ctx->saved_data["transposed"] = a.transposed;
    return apply_on_loops(*make_operator(a), v, /*transposed=*/false);
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto saved = ctx->get_saved_variables();
    const auto tensors = at::TensorList(saved).slice(1);
    variable_list all(tensors.size() + 2);
    if (!grads[0].defined()) return all;
    OperatorSpec a{ctx->saved_data["kind"].toStringRef(), ctx->saved_data["shape"].toIntVector(),
                   ctx->saved_data["parameters"].toDoubleVector(), tensors.vec(),
                   ctx->saved_data["transposed"].toBool()};
    std::vector<int64_t> needed{0};
    for (size_t i = 1; i <= tensors.size(); ++i) needed.push_back(ctx->needs_input_grad(i));
    if (std::find(needed.begin(), needed.end(), 1) != needed.end()) {
      const auto of_tensors = gradients_of_tensors(a, saved[0], grads[0], needed);
      for (size_t i = 0; i < tensors.size(); ++i)
        if (needed[i + 1]) all[i + 1] = of_tensors[i];
    }
    a.transposed = !a.transposed;
    if (ctx->needs_input_grad(0)) all[0] = product(a, grads[0]);
    return all;
  }

 private:
  /// ∂⟨ḡ, A v⟩/∂ each tensor; by what autograd records where it has to be differentiable.
  static std::vector<at::Tensor> gradients_of_tensors(const OperatorSpec& a, const at::Tensor& v, const at::Tensor& bar,
                                                      at::IntArrayRef needed) {
    if (!at::GradMode::is_enabled()) return make_operator(a)->product_rule(bar, v);
    const auto inputs = a.tensors;
    return gradients_of({make_operator(a)->apply(v)}, {bar}, inputs, needed.slice(1), /*create_graph=*/true);
  }
};

at::Tensor product(const OperatorSpec& a, const at::Tensor& v) {
  const auto made = make_operator(a);
  made->check_vector(v);
  const bool plain = is_plain(v) && all_plain(a.tensors) && !has_tangent(v) && !any_tangent(a.tensors);
  if (!plain || !no_mode_is_on()) return made->apply(v);
  const bool recorded = at::GradMode::is_enabled() && (v.requires_grad() || any_requires_grad(a.tensors));
  if (!recorded) return apply_on_loops(*made, v, /*transposed=*/false);
  return is_function(a) ? made->apply(v) : Product::apply(v, at::TensorList(a.tensors), a);
}

at::Tensor apply(const at::Tensor& v, at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                 at::ArrayRef<double> parameters, bool transposed) {
  const auto a = spec(tensors, kind, shape, parameters, transposed);
  // A is linear. Torch's own forward mode takes hundreds of µs for each product with a tensor that has no tangent.
  if (has_tangent(v) && !any_tangent(tensors) && !is_function(a)) {
    const auto tangent = product(a, v._fw_grad(/*level=*/0));
    return at::_make_dual(product(a, v._fw_primal(/*level=*/0)), tangent, /*level=*/0);
  }
  return product(a, v);
}

at::Tensor diagonal(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                    at::ArrayRef<double> parameters) {
  return make_operator(spec(tensors, kind, shape, parameters))->diagonal();
}

at::Tensor dense(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape, at::ArrayRef<double> parameters,
                 at::ScalarType dtype) {
  return make_operator(spec(tensors, kind, shape, parameters))->dense(at::TensorOptions().dtype(dtype));
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(prdp, m) {
  m.def(
      "apply(Tensor v, Tensor[] tensors, str kind, int[] shape, float[] parameters, "
      "bool transposed) -> Tensor",
      apply);
  m.def("diagonal(Tensor[] tensors, str kind, int[] shape, float[] parameters) -> Tensor", diagonal);
  m.def("dense(Tensor[] tensors, str kind, int[] shape, float[] parameters, ScalarType dtype) -> Tensor", dense);
}

// torch.func.vmap goes through what they are made of.
TORCH_LIBRARY_IMPL(prdp, FuncTorchBatchedDecomposition, m) {
  m.impl("apply", apply);
  m.impl("diagonal", diagonal);
  m.impl("dense", dense);
}

}  // namespace prdp
