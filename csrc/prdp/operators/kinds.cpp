#include "prdp/operators/kinds.h"

#include "prdp/operators/burgers_operator.h"
#include "prdp/operators/function_operator.h"
#include "prdp/operators/laplacian_operator.h"
#include "prdp/operators/matrix_operator.h"
#include "prdp/operators/navier_stokes_operator.h"
#include "prdp/operators/stencil_operator.h"

namespace prdp {

namespace {

template <class T>
std::unique_ptr<Operator> make(const OperatorSpec& spec) {
  return std::make_unique<T>(spec);
}

using Axes = std::vector<int64_t>;

const std::vector<OperatorKind> kKinds{
    {"heat", "Heat", make<HeatOperator>, Axes{0}},
    {"poisson", "Poisson", make<PoissonOperator>, Axes{}},
    {"burgers", "Burgers", make<BurgersOperator>, Axes{kLikeState, 0}},
    {"navier_stokes", "NavierStokes", make<NavierStokesOperator>, Axes{kLikeState, 0}, /*has_pressure=*/true},
    {"stencil", "Stencil", make<StencilOperator>, Axes{kLikeState}},
    {"dense", "Matrix", make<DenseOperator>, Axes{3}},
    {"function", "Function", make<FunctionOperator>, std::nullopt},
    {"csr", "Matrix", make<CsrOperator>, Axes{2, 2, 2}},
};

}  // namespace

const OperatorKind& operator_kind(const std::string& kind) { return row_of(kKinds, "operator", kind); }

}  // namespace prdp
