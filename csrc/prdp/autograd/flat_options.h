#pragma once
#include <tuple>

#include "prdp/solvers/solver.h"

/// SolveOptions as they cross torch's dispatcher: names and numbers at the end of an op's arguments.
namespace prdp {

#define PRDP_OPTIONS_SCHEMA                                                                         \
  "str solver, SymInt max_iter, float rtol, int restart, str backward, SymInt? adjoint_max_iter, " \
  "float? adjoint_rtol, str on_failure, int adjoint_log, int checkpoint_every=0"

namespace detail {

template <class Signature>
struct AddOptions;
template <class Result, class... Front>
struct AddOptions<Result(Front...)> {
  using Type = Result(Front..., c10::string_view, c10::SymInt, double, int64_t, c10::string_view,
                      std::optional<c10::SymInt>, std::optional<double>, c10::string_view, int64_t, int64_t);
};

}  // namespace detail

/// The type of an op's kernel whose schema ends in PRDP_OPTIONS_SCHEMA.
template <class Signature>
using WithOptions = typename detail::AddOptions<Signature>::Type;

/// Raises ValueError for names that do not exist.
inline SolveOptions unflatten(c10::string_view solver, c10::SymInt max_iter, double rtol, int64_t restart,
                              c10::string_view backward, std::optional<c10::SymInt> adjoint_max_iter,
                              std::optional<double> adjoint_rtol, c10::string_view on_failure,
                              int64_t adjoint_log, int64_t checkpoint_every) {
  return {{method_from_name(solver), std::move(max_iter), rtol, restart},
          backward_from_name(backward),
          std::move(adjoint_max_iter),
          adjoint_rtol,
          on_failure_from_name(on_failure),
          adjoint_log,
          checkpoint_every};
}

/// Calls an op through the dispatcher with `o` behind its other arguments.
template <class Op, class... Front>
auto call_with_options(const Op& op, const SolveOptions& o, const Front&... front) {
  return op.call(front..., name(o.solver.method), o.solver.max_iter, o.solver.rtol, o.solver.restart,
                 name(o.backward), o.adjoint_max_iter, o.adjoint_rtol, name(o.on_failure), o.adjoint_log,
                 o.checkpoint_every);
}

}  // namespace prdp
