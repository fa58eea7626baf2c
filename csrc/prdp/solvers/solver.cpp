#include <array>
#include <sstream>
#include <utility>

#include "prdp/error_text.h"
#include "prdp/operators/kinds.h"
#include "prdp/solvers/methods.h"

namespace prdp {

namespace {

template <class Enum, size_t N>
using Names = std::array<std::pair<Enum, std::string_view>, N>;

constexpr auto kMethodNames = [] {
  Names<Method, kTraits.size()> names{};
  for (size_t i = 0; i < names.size(); ++i) names[i] = {kTraits[i].method, kTraits[i].name};
  return names;
}();
constexpr Names<Backward, 3> kBackwards{
    {{Backward::kImplicit, "implicit"}, {Backward::kUnrolled, "unrolled"}, {Backward::kNone, "none"}}};
constexpr Names<OnFailure, 4> kOnFailures{{{OnFailure::kRaise, "raise"},
                                           {OnFailure::kWarn, "warn"},
                                           {OnFailure::kReturn, "return"},
                                           {OnFailure::kZeroGrad, "zero_grad"}}};

constexpr Names<Start, 2> kStarts{{{Start::kZero, "zero"}, {Start::kState, "state"}}};

template <class Enum, size_t N>
std::string_view to_name(const Names<Enum, N>& names, Enum value) {
  for (const auto& [known, text] : names)
    if (known == value) return text;
  TORCH_CHECK(false, "unnamed enumerator");
}

template <class Enum, size_t N>
Enum from_name(const Names<Enum, N>& names, std::string_view wanted, const char* argument) {
  std::ostringstream allowed;
  for (const auto& [value, text] : names) {
    if (text == wanted) return value;
    allowed << (allowed.tellp() > 0 ? ", " : "") << text;
  }
  TORCH_CHECK_VALUE(false, argument, ": unknown name '", wanted, "'; allowed: ", allowed.str());
}

}  // namespace

std::string_view name(Method method) { return traits(method).name; }
std::string_view name(Backward backward) { return to_name(kBackwards, backward); }
std::string_view name(OnFailure on_failure) { return to_name(kOnFailures, on_failure); }
std::string_view name(Start start) { return to_name(kStarts, start); }
Method method_from_name(std::string_view name) { return from_name(kMethodNames, name, "solver"); }
Backward backward_from_name(std::string_view name) { return from_name(kBackwards, name, "backward"); }
OnFailure on_failure_from_name(std::string_view name) { return from_name(kOnFailures, name, "on_failure"); }
Start start_from_name(std::string_view name) { return from_name(kStarts, name, "start"); }

namespace {

void check_budget(const char* who, const char* prefix, const c10::SymInt& max_iter, double rtol) {
  // A symbolic max_iter is checked when its number is known, as the graph runs.
  const bool is_missing = !max_iter.is_symbolic() && max_iter.expect_int() == kToBeGiven;
  TORCH_CHECK_VALUE(max_iter.is_symbolic() || max_iter.expect_int() >= 0, who, ": ", prefix,
                    "max_iter must be >= 0, got ", max_iter,
                    is_missing ? in_language("", " (which it is where none is given)") : "");
  TORCH_CHECK_VALUE(rtol >= 0.0, who, ": ", prefix, "rtol must be >= 0, got ", rtol);
  TORCH_CHECK_VALUE(rtol < 1.0, who, ": ", prefix, "rtol must be < 1, got ", rtol, "; u = 0 would meet it");
}

}  // namespace

Preconditioner Preconditioner::transposed() const {
  auto other = *this;
  other.spec_.transposed = !spec_.transposed;
  return other;
}

std::string Preconditioner::title() const { return is_operator() ? operator_kind(spec_.kind).title : spec_.kind; }

void Solver::check(const char* who) const {
  check_budget(who, "", max_iter, rtol);
  TORCH_CHECK_VALUE(restart >= 1, who, ": restart must be >= 1, got ", restart);
  if (method == Method::kMultigrid) {
    TORCH_CHECK_VALUE(preconditioner.is_multigrid(), who, ": the method multigrid needs Preconditioner::multigrid()");
  } else {
    TORCH_CHECK_VALUE(!preconditioner || traits(method).takes_preconditioner, who, ": the method ",
                      traits(method).label, " takes no preconditioner; CG, BiCGStab, GMRES and MINRES take one");
  }
  TORCH_CHECK_VALUE(preconditioner.smoothing() >= 1, who, ": smoothing must be >= 1, got ", preconditioner.smoothing());
}

void SolveOptions::check(const char* who) const {
  solver.check(who);
  check_budget(who, "adjoint_", adjoint_max_iter.value_or(0), adjoint_rtol.value_or(0.0));
  TORCH_CHECK_VALUE(checkpoint_every >= kCheckpointSqrt, who,
                    ": checkpoint_every must be >= 1, 0 for none or kCheckpointSqrt, got ", checkpoint_every);
  TORCH_CHECK_VALUE(checkpoint_every == 0 || backward == Backward::kUnrolled, who,
                    ": checkpoint_every is for backward = unrolled alone, got ", name(backward));
}

}  // namespace prdp
