#include "prdp/solvers/operator_messages.h"

#include "prdp/error_text.h"
#include "prdp/kernels/kernel.h"
#include "prdp/operators/probes.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/null_space_messages.h"
#include "prdp/solvers/unnamed_null_space.h"

namespace prdp {

namespace {

// Causes that may not be there: in words, or empty.

/// The rows of A, or its columns, differ so much in size that the dtype loses the small ones beside the large ones.
std::string badly_scaled(const FailedSample& sample, bool columns) {
  const auto sizes = row_sizes(sample.a, sample.b, /*transposed=*/columns).select(0, sample.index);
  const auto there = sizes.masked_select(sizes.gt(0));
  if (there.numel() == 0) return {};
  const double spread = (there.max() / there.min()).item<double>();
  if (!(spread > 1.0 / (64.0 * epsilon_of(sample.b)))) return {};
  const bool direct = sample.method().is_direct;
  const char* remedy = sample.is_single() ? ", or take float64" : direct ? "" : ", or take Direct";
  return c10::str(direct ? "A is singular, or has badly scaled " : "A has badly scaled ", columns ? "columns" : "rows",
                  ": the largest is ", three_digits(spread),
                  " times the smallest, which is lost beside it; scale A and b", remedy);
}

std::string badly_scaled(const FailedSample& sample) {
  auto rows = badly_scaled(sample, /*columns=*/false);
  return rows.empty() ? badly_scaled(sample, /*columns=*/true) : rows;
}

/// A row of A that is zero, or a column.
std::string empty_line(const FailedSample& sample) try {
  if (is_singular(sample.role.a)) return {};  // somebody has named what it maps to zero
  const auto v = unstructured_like(sample.b), w = v.flatten(1).roll(1, 1).view_as(v);
  for (const bool columns : {false, true}) {
    const auto product = [&](const at::Tensor& of) {  // the loops scale A, which may lose a small row
      return sample.of(columns ? sample.a.apply_transpose(of) : sample.a.apply(of));
    };
    const auto empty = product(v).eq(0).logical_and(product(w).eq(0));
    const auto count = empty.sum().item<int64_t>();
    if (count == 0) continue;
    const char* line = columns ? "column" : "row";
    const auto first = as_tuple(first_true(empty));
    return (count == 1 ? c10::str(line, " ", first, " of A is zero")
                       : c10::str(count, " ", line, "s of A are zero, such as ", first)) +
           ", as those of a node in no element are; put 1 on the diagonal there, or leave these unknowns out" +
           (sample.is_single() ? "; where float32 has lost them, take float64" : "");
  }
  return {};
} catch (const std::exception&) {  // a function without a transpose has nothing to add to a message
  return {};
}

/// The factors of a diffusion lose what `Direct` needs of it (Kernel::has_definite_factors).
std::string lost_in_factors(const FailedSample& sample) {
  const bool null_space_is_named = is_singular(sample.role.a);
  if (!sample.method().is_direct || !sample.is_diffusion() || null_space_is_named) return {};
  const auto sizes = [&](const at::Tensor& v) { return v.to(at::kDouble).abs(); };
  const auto diagonal = sizes(sample.of(sample.a.diagonal())), row_sums = sizes(sample.row_sums());
  if ((diagonal.max() / diagonal.min()).item<double>() >= kernels::kWidestRowsOfFactors)
    return "κ differs by more than a factor of 1e13, beyond what factors in float64 hold; bring its largest and its "
           "smallest value nearer to each other";
  if ((diagonal.sum() / row_sums.sum()).item<double>() >= kernels::kWidestRowsOfFactors)
    return "the shift and the sides that hold u are 1e13 times smaller than κ/dx², beyond what factors in float64 "
           "hold; make κ smaller or the shift larger";
  return {};
}

}  // namespace

std::string cause_in_operator(const FailedSample& sample, SolveStatus status) {
  const bool broke_down = status == SolveStatus::kBreakdown;
  const bool failed = broke_down || status == SolveStatus::kDiverged;
  if (status != SolveStatus::kNonfiniteInput && status != SolveStatus::kNonfiniteOperator)
    if (auto found = empty_line(sample); !found.empty()) return found;
  if (failed || is_unsolved(status))
    if (auto found = undeclared_null_space(sample); !found.empty()) return found;
  if (broke_down)
    if (auto found = lost_in_factors(sample); !found.empty()) return found;
  return failed || status == SolveStatus::kStagnated ? badly_scaled(sample) : "";
}

}  // namespace prdp
