#pragma once
#include <optional>
#include <tuple>
#include <utility>

#include "prdp/solvers/solve.h"

/// SolveOptions and results as they cross torch's dispatcher: the options as names and numbers at the end of an op's
/// arguments, a result as a tuple.
namespace prdp {

/// Behind them an op has either of these.
#define PRDP_X0_SCHEMA ", Tensor? x0=None"
#define PRDP_FROM_STATE_SCHEMA ", bool from_state=False"

#define PRDP_OPTIONS_SCHEMA                                                                                \
  "str solver, SymInt max_iter, float rtol, int restart, str preconditioner, int[] preconditioner_shape, " \
  "float[] preconditioner_parameters, Tensor[] preconditioner_tensors, bool preconditioner_transposed, "   \
  "str backward, SymInt? adjoint_max_iter, float? adjoint_rtol, str on_failure, int adjoint_log, "         \
  "int checkpoint_every=0"

namespace detail {

template <class Signature, class Last>
struct AddOptions;
template <class Result, class... Front, class Last>
struct AddOptions<Result(Front...), Last> {
  using Type = Result(Front..., c10::string_view, c10::SymInt, double, int64_t, c10::string_view, at::IntArrayRef,
                      at::ArrayRef<double>, at::TensorList, bool, c10::string_view, std::optional<c10::SymInt>,
                      std::optional<double>, c10::string_view, int64_t, int64_t, Last);
};

}  // namespace detail

/// The type of the kernel of an op whose schema ends in PRDP_OPTIONS_SCHEMA PRDP_FROM_STATE_SCHEMA, and in
/// PRDP_OPTIONS_SCHEMA PRDP_X0_SCHEMA.
template <class Signature>
using WithOptions = typename detail::AddOptions<Signature, bool>::Type;
template <class Signature>
using WithOptionsAndX0 = typename detail::AddOptions<Signature, const std::optional<at::Tensor>&>::Type;

/// Raises ValueError for names that do not exist.
inline SolveOptions unflatten(c10::string_view solver, c10::SymInt max_iter, double rtol, int64_t restart,
                              c10::string_view preconditioner, at::IntArrayRef shape, at::ArrayRef<double> parameters,
                              at::TensorList tensors, bool transposed, c10::string_view backward,
                              std::optional<c10::SymInt> adjoint_max_iter, std::optional<double> adjoint_rtol,
                              c10::string_view on_failure, int64_t adjoint_log, int64_t checkpoint_every,
                              bool from_state) {
  OperatorSpec inverse{std::string(preconditioner), shape.vec(), parameters.vec(), tensors.vec(), transposed};
  return {{method_from_name(solver), std::move(max_iter), rtol, restart, std::move(inverse)},
          backward_from_name(backward),
          std::move(adjoint_max_iter),
          adjoint_rtol,
          on_failure_from_name(on_failure),
          adjoint_log,
          checkpoint_every,
          from_state ? Start::kState : Start::kZero};
}

/// The same of an op with an x0 of its own, undefined where there is none.
struct OptionsAndX0 {
  SolveOptions options;
  at::Tensor x0;
};
template <class... Flat>
OptionsAndX0 unflatten_with_x0(Flat... flat) {
  auto all = std::make_tuple(std::move(flat)...);
  constexpr size_t last = sizeof...(Flat) - 1;
  return [&]<size_t... I>(std::index_sequence<I...>) -> OptionsAndX0 {
    return {unflatten(std::move(std::get<I>(all))..., false), std::get<last>(all).value_or(at::Tensor())};
  }(std::make_index_sequence<last>());
}

namespace detail {

template <class Op, class Last, class... Front>
auto call_with(const Op& op, const SolveOptions& o, const Last& last, const Front&... front) {
  const auto& m = o.solver.preconditioner.spec();
  return op.call(front..., name(o.solver.method), o.solver.max_iter, o.solver.rtol, o.solver.restart,
                 c10::string_view(m.kind), at::IntArrayRef(m.shape), at::ArrayRef<double>(m.parameters),
                 at::TensorList(m.tensors), m.transposed, name(o.backward), o.adjoint_max_iter, o.adjoint_rtol,
                 name(o.on_failure), o.adjoint_log, o.checkpoint_every, last);
}

}  // namespace detail

/// Calls an op through the dispatcher with `o` behind its other arguments.
template <class Op, class... Front>
auto call_with_options(const Op& op, const SolveOptions& o, const Front&... front) {
  return detail::call_with(op, o, o.start == Start::kState, front...);
}
template <class Op, class... Front>
auto call_with_x0(const Op& op, const SolveOptions& o, const at::Tensor& x0, const Front&... front) {
  return detail::call_with(op, o, x0.defined() ? std::optional<at::Tensor>(x0) : std::nullopt, front...);
}

/// A SolveResult as an op returns it, and back.
#define PRDP_REPORT_SCHEMA \
  "Tensor iterations, Tensor residual, Tensor status, Tensor operator_applications, Tensor floor"
using SolveOutputs = std::tuple<at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor>;
inline SolveOutputs outputs_of(SolveResult result) {
  auto& info = result.info;
  return {std::move(result.u),
          std::move(info.iterations),
          std::move(info.residual),
          std::move(info.status),
          std::move(info.operator_applications),
          std::move(info.floor)};
}
inline SolveResult result_of(SolveOutputs outputs) {
  auto& [u, iterations, residual, status, applications, floor] = outputs;
  return {std::move(u),
          {std::move(iterations), std::move(residual), std::move(status), std::move(applications), std::move(floor)}};
}

/// The same of fake tensors: a report of numbers of these sizes, in the dtype of `like`.
inline SolveInfo fake_info(const at::Tensor& like, c10::SymIntArrayRef sizes) {
  const auto counts = [&] { return at::empty_symint(sizes, like.options().dtype(at::kLong)); };
  const auto numbers = [&] { return at::empty_symint(sizes, like.options()); };
  return {counts(), numbers(), counts(), counts(), numbers()};
}

}  // namespace prdp
