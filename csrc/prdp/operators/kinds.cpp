#include "prdp/operators/kinds.h"

#include "prdp/operators/burgers_operator.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/function_operator.h"
#include "prdp/operators/laplacian_operator.h"
#include "prdp/operators/matrix_operator.h"
#include "prdp/operators/navier_stokes_operator.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/operators/stencil_operator.h"

namespace prdp {

namespace {

template <class T>
std::unique_ptr<Operator> make(const OperatorSpec& spec) {
  return std::make_unique<T>(spec);
}

constexpr const char* kDiffusion = "Diffusion";
constexpr const char* kStencil = "Stencil";
constexpr const char* kMatrix = "Matrix";
constexpr const char* kFunction = "Function";

/// With the bases of the two null spaces behind the other tensors.
template <class T, const char* const& title>
std::unique_ptr<Operator> singular(const OperatorSpec& spec) {
  return make_singular<T>(spec, title);
}

using Axes = std::vector<int64_t>;

const std::vector<OperatorKind> kKinds{
    {"heat", "Heat", make<HeatOperator>, Axes{0}},
    {"poisson", "Poisson", make<PoissonOperator>, Axes{}},
    {"burgers", "Burgers", make<BurgersOperator>, Axes{kLikeState, 0}},
    {"navier_stokes", "NavierStokes", make<NavierStokesOperator>, Axes{kLikeState, 0}, /*has_pressure=*/true},
    {"diffusion", kDiffusion, make<DiffusionOperator>, Axes{kLikeField, kLikeField, kLikeSide}},
    {"stencil", kStencil, make<StencilOperator>, Axes{kLikeState}},
    {"dense", kMatrix, make<DenseOperator>, Axes{3}},
    {"function", kFunction, make<FunctionOperator>, std::nullopt},
    {"csr", kMatrix, make<CsrOperator>, Axes{2, 2, 2}},
    {"singular_diffusion", kDiffusion, singular<DiffusionOperator, kDiffusion>, Axes{kLikeField, kLikeField, 0, 0}},
    {"singular_stencil", kStencil, singular<StencilOperator, kStencil>, Axes{kLikeState, 0, 0}},
    {"singular_dense", kMatrix, singular<DenseOperator, kMatrix>, Axes{3, 0, 0}},
    {"singular_csr", kMatrix, singular<CsrOperator, kMatrix>, Axes{2, 2, 2, 0, 0}},
    {"singular_function", kFunction, singular<FunctionOperator, kFunction>, std::nullopt},
};

}  // namespace

const OperatorKind& operator_kind(const std::string& kind) { return row_of(kKinds, "operator", kind); }

std::optional<std::vector<int64_t>> batched_axes(const std::string& kind, int64_t axes, size_t tensors) {
  auto of_tensors = operator_kind(kind).batched_axes;
  if (!of_tensors) return std::nullopt;
  if (!of_tensors->empty()) of_tensors->resize(tensors, of_tensors->back());
  for (auto& n : *of_tensors)
    if (n < 0) n += axes - kLikeSide;
  return of_tensors;
}

void check_devices(const OperatorSpec& a, const at::Tensor& b) {
  for (const auto& t : a.tensors) {
    const bool beside = t.device() == b.device() || (t.dim() == 0 && t.is_cpu()) || t.sym_numel() == 0 ||
                        (is_function(a) && t.is_meta() == b.is_meta());
    TORCH_CHECK_VALUE(beside, operator_kind(a.kind).title, ": a tensor of it is on ", t.device(),
                      " but the vector is on ", b.device(),
                      t.is_meta() ? "; it has no values: give it some, as with to_empty and load_state_dict" : "");
  }
}

}  // namespace prdp
