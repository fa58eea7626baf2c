#include "prdp/operators/kinds.h"

#include "prdp/operators/burgers_operator.h"
#include "prdp/operators/csr_operator.h"
#include "prdp/operators/dense_operator.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/function_operator.h"
#include "prdp/operators/laplacian_operator.h"
#include "prdp/operators/navier_stokes_operator.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/operators/stencil_operator.h"

namespace prdp {

namespace {

template <class T>
std::unique_ptr<Operator> make(const OperatorSpec& spec) {
  return std::make_unique<T>(spec);
}

using Axes = std::vector<int64_t>;

const std::vector<OperatorKind> kKinds{
    {"heat", "Heat", make<HeatOperator>, Axes{1}},
    {"poisson", "Poisson", make<PoissonOperator>, Axes{}},
    {"burgers", "Burgers", make<BurgersOperator>, Axes{kLikeState, 1}},
    {"navier_stokes", "NavierStokes", make<NavierStokesOperator>, Axes{kLikeState, 1},
     /*takes_null_spaces=*/false, /*has_pressure=*/true},
    {"diffusion", "Diffusion", make<DiffusionOperator>, Axes{kLikeField, kLikeField, kLikeSide},
     /*takes_null_spaces=*/true},
    {"diffusion_per_axis", "Diffusion", make<DiffusionOperator>, Axes{kLikeState, kLikeField, kLikeSide},
     /*takes_null_spaces=*/true},
    {"stencil", "Stencil", make<StencilOperator>, Axes{kLikeState}, /*takes_null_spaces=*/true},
    {"dense", "Matrix", make<DenseOperator>, Axes{3}, /*takes_null_spaces=*/true},
    {"csr", "Matrix", make<CsrOperator>, Axes{2, 2, 2}, /*takes_null_spaces=*/true},
    {"function", "Function", make<FunctionOperator>, std::nullopt, /*takes_null_spaces=*/true},
};

}  // namespace

const OperatorKind& operator_kind(const std::string& kind) {
  if (!is_singular(kind)) return row_of(kKinds, "operator", kind);
  const auto& row = row_of(kKinds, "operator", kind.substr(kSingular.size()));
  TORCH_CHECK_VALUE(row.takes_null_spaces, "operator: ", row.title, " takes no null spaces");
  return row;
}

std::optional<std::vector<int64_t>> batched_axes(const std::string& kind, int64_t axes, size_t tensors) {
  auto of_tensors = operator_kind(kind).batched_axes;
  if (!of_tensors) return std::nullopt;
  const size_t bases = is_singular(kind) ? 2 : 0;
  if (!of_tensors->empty()) of_tensors->resize(tensors - bases, of_tensors->back());
  for (auto& n : *of_tensors)
    // A side, the lowest constant, has `axes` of them, the batch included; each constant above it has one more.
    if (n < 0) n += axes - kLikeSide;
  of_tensors->resize(of_tensors->size() + bases, axes + 3);  // of null spaces: as a vector, behind how many there are
  return of_tensors;
}

void check_devices(const OperatorSpec& a, const at::Tensor& b) {
  for (const auto& t : a.tensors) {
    TORCH_CHECK_VALUE(t.defined(), operator_kind(a.kind).title, ": one of its tensors is undefined");
    const bool beside = t.device() == b.device() || (t.dim() == 0 && t.is_cpu()) || t.sym_numel() == 0 ||
                        (is_function(a) && t.is_meta() == b.is_meta());
    TORCH_CHECK_VALUE(beside, operator_kind(a.kind).title, ": one of its tensors is on ", t.device(),
                      ", the vector on ", b.device(),
                      t.is_meta() ? "; it has no values: give it some, as with to_empty and load_state_dict" : "");
  }
}

}  // namespace prdp
