#pragma once
#include <c10/util/StringUtil.h>

#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "prdp/operators/operator.h"

namespace prdp {

/// What the library knows about a kind of operator: a row of the table in kinds.cpp.
struct OperatorKind {
  const char* kind;   // as in OperatorSpec
  const char* title;  // as in messages
  std::unique_ptr<Operator> (*make)(const OperatorSpec& spec);
  /// The number of axes of each tensor where it has one for the batch: 0 if all samples share it, or one of the below.
  /// The last stands for all that follow. nullopt if that is not known, as for the tensors of a function.
  std::optional<std::vector<int64_t>> batched_axes;
  bool takes_null_spaces = false;  // a kind "singular_…" names its null spaces, by two tensors behind the others
  bool has_pressure = false;  // rows without a diagonal, and a mean that A maps to zero
};

/// Before the kind of an operator whose null spaces are named (singular_operator.h).
inline constexpr std::string_view kSingular = "singular_";
inline bool is_singular(const std::string& kind) { return kind.starts_with(kSingular); }
inline bool is_singular(const OperatorSpec& a) { return is_singular(a.kind); }

/// Of a tensor that is (batch, channel, *shape), (batch, *shape), or (batch, *side) with a side of that shape.
inline constexpr int64_t kLikeState = -1, kLikeField = -2, kLikeSide = -3;

/// For each of an operator's `tensors` tensors, how many axes it has if the batch is one of them; `axes`: of the grid.
std::optional<std::vector<int64_t>> batched_axes(const std::string& kind, int64_t axes, size_t tensors);

/// The row of a table. Raises ValueError for a kind that has none.
template <class Row>
const Row& row_of(const std::vector<Row>& rows, const char* table, const std::string& kind) {
  for (const auto& row : rows)
    if (row.kind == kind) return row;
  std::vector<std::string> known;
  for (const auto& row : rows) known.emplace_back(row.kind);
  TORCH_CHECK_VALUE(false, table, ": unknown kind '", kind, "'; allowed: ", c10::Join(", ", known));
}

/// Raises ValueError for an unknown kind.
const OperatorKind& operator_kind(const std::string& kind);

/// Raises ValueError unless the tensors of A can be used with b: on its device, or plain numbers on the CPU. A kernel
/// for fake tensors must not answer for real ones: its results are memory that nobody wrote.
void check_devices(const OperatorSpec& a, const at::Tensor& b);

}  // namespace prdp
