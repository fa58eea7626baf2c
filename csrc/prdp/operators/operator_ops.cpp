#include <ATen/core/grad_mode.h>
#include <torch/library.h>

#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"

/// The operators as torch ops, made of plain tensor operations, so that autograd goes through them; without it, of the
/// CPU loops.
namespace prdp {

namespace {

OperatorSpec spec(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape, at::ArrayRef<double> parameters,
                  bool transposed = false) {
  return {std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), transposed};
}

/// By loops where nobody else has to see the operations.
at::Tensor product(const Operator& a, const at::Tensor& v, at::TensorList tensors) {
  const bool recorded = at::GradMode::is_enabled() && (v.requires_grad() || any_requires_grad(tensors));
  const bool plain = is_plain(v) && all_plain(tensors) && !has_tangent(v) && !any_tangent(tensors);
  return !recorded && no_mode_is_on() && plain ? apply_on_loops(a, v, /*transposed=*/false) : a.apply(v);
}

at::Tensor apply(const at::Tensor& v, at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                 at::ArrayRef<double> parameters, bool transposed) {
  const auto described = spec(tensors, kind, shape, parameters, transposed);
  const auto a = make_operator(described);
  a->check_vector(v);
  // A is linear. Torch's own forward mode takes hundreds of µs for each product with a tensor that has no tangent.
  if (has_tangent(v) && !any_tangent(tensors) && !is_function(described)) {
    const auto tangent = product(*a, v._fw_grad(/*level=*/0), tensors);
    return at::_make_dual(product(*a, v._fw_primal(/*level=*/0), tensors), tangent, /*level=*/0);
  }
  return product(*a, v, tensors);
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
