#include "prdp/steppers/equation.h"

#include <torch/library.h>

namespace prdp {

OperatorSpec equation_operator(const Equation& equation, const at::Tensor&) {
  return {equation.kind, equation.shape, equation.parameters, equation.tensors};
}

at::Tensor equation_rhs(const Equation& equation, const at::Tensor& u) {
  if (equation.kind == "poisson") return -u;  // Δu = -p
  return u;
}

SolveResult step(const Equation& equation, const at::Tensor& u, const SolveOptions& options) {
  return linear_solve(equation_operator(equation, u), equation_rhs(equation, u), options);
}

namespace {

using Outputs = std::tuple<at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor>;

Outputs step_op(const at::Tensor& u, at::TensorList tensors, c10::string_view kind,
                at::IntArrayRef shape, at::ArrayRef<double> parameters, c10::string_view solver,
                c10::SymInt max_iter, double rtol, int64_t restart, c10::string_view backward,
                std::optional<c10::SymInt> adjoint_max_iter, std::optional<double> adjoint_rtol,
                c10::string_view on_failure, int64_t adjoint_log) {
  const Equation equation{std::string(kind), shape.vec(), parameters.vec(), tensors.vec()};
  const auto [next, info] = step(equation, u,
                                 {{method_from_name(solver), std::move(max_iter), rtol, restart},
                                  backward_from_name(backward),
                                  std::move(adjoint_max_iter),
                                  adjoint_rtol,
                                  on_failure_from_name(on_failure),
                                  adjoint_log});
  return {next, info.iterations, info.residual, info.status, info.operator_applications};
}

at::Tensor rhs_op(const at::Tensor& u, c10::string_view kind) {
  return equation_rhs({std::string(kind), {}, {}, {}}, u);
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(prdp, m) {
  m.def("step(Tensor u, Tensor[] tensors, str kind, int[] shape, float[] parameters, str solver, "
        "SymInt max_iter, float rtol, int restart, str backward, SymInt? adjoint_max_iter, float? adjoint_rtol, "
        "str on_failure, int adjoint_log) -> (Tensor u_next, Tensor iterations, Tensor residual, "
        "Tensor status, Tensor operator_applications)",
        step_op);
  m.def("rhs(Tensor u, str kind) -> Tensor", rhs_op);
}

}  // namespace prdp
