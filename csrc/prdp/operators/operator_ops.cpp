#include <ATen/core/grad_mode.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/library.h>

#include <algorithm>

#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"

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

/// A v by the loops, as one node, where A is constant: recorded in tensor operations it would take ten times as long,
/// and keep what each of them does. Its derivative is Aᵀ.
class Product : public torch::autograd::Function<Product> {
 public:
  static at::Tensor forward(AutogradContext* ctx, const at::Tensor& v, const OperatorSpec& a) {
    if (!a.tensors.empty()) ctx->save_for_backward(a.tensors);  // to notice where one is changed meanwhile
    ctx->saved_data["kind"] = a.kind;
    ctx->saved_data["shape"] = a.shape;
    ctx->saved_data["parameters"] = a.parameters;
    ctx->saved_data["transposed"] = a.transposed;
    ctx->saved_data["has tensors"] = !a.tensors.empty();
    return apply_on_loops(*make_operator(a), v, /*transposed=*/false);
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    if (!grads[0].defined()) return {{}, {}};
    const OperatorSpec transpose{ctx->saved_data["kind"].toStringRef(), ctx->saved_data["shape"].toIntVector(),
                                 ctx->saved_data["parameters"].toDoubleVector(),
                                 ctx->saved_data["has tensors"].toBool() ? ctx->get_saved_variables() : variable_list{},
                                 !ctx->saved_data["transposed"].toBool()};
    return {product(transpose, grads[0]), {}};
  }
};

bool is_constant(const OperatorSpec& a) {
  const auto is_inference = [](const at::Tensor& t) { return t.is_inference(); };  // no node can save it
  return !any_requires_grad(a.tensors) && !any_tangent(a.tensors) && !is_function(a) &&
         std::none_of(a.tensors.begin(), a.tensors.end(), is_inference);
}

at::Tensor product(const OperatorSpec& a, const at::Tensor& v) {
  const auto made = make_operator(a);
  made->check_vector(v);
  const bool plain = is_plain(v) && all_plain(a.tensors) && !has_tangent(v) && !any_tangent(a.tensors);
  if (!plain || !no_mode_is_on()) return made->apply(v);
  const bool recorded = at::GradMode::is_enabled() && (v.requires_grad() || any_requires_grad(a.tensors));
  if (!recorded) return apply_on_loops(*made, v, /*transposed=*/false);
  return is_constant(a) ? Product::apply(v, a) : made->apply(v);
}

at::Tensor apply(const at::Tensor& v, at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                 at::ArrayRef<double> parameters, bool transposed) {
  const auto a = spec(tensors, kind, shape, parameters, transposed);
  // A is linear. Torch's own forward mode takes hundreds of µs for each product with a tensor that has no tangent.
  if (has_tangent(v) && is_constant(a)) {
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
