#pragma once
#include "prdp/steppers/equation.h"

namespace prdp {

/// A linear map of states.
using StateMap = at::Tensor (*)(const Equation& equation, const at::Tensor& u);

/// What the library knows about an equation A(u) u_next = b(u): a row of the table in equation_kinds.cpp. Its operator
/// has a row of its own (operators/kinds.h).
struct EquationKind {
  const char* kind;
  bool periodic;
  int64_t channels;  // of a state; kPerAxis: one for each axis
  bool linearised;   // A depends on the state
  StateMap rhs = nullptr;             // b(u); null: b is the state
  StateMap rhs_transposed = nullptr;  // ū for b̄
};

inline constexpr int64_t kPerAxis = 0;

/// Raises ValueError for an unknown kind.
const EquationKind& equation_kind(const std::string& kind);

}  // namespace prdp
