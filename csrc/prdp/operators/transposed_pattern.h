#pragma once
#include <ATen/ATen.h>

namespace prdp {

/// The compressed rows of a transposed matrix: `order` says which value of the given matrix comes where.
struct TransposedPattern {
  at::Tensor crow, col, order;
};

/// The indices of a matrix, (…) or (batch, …), as they were given, and as int64 in contiguous memory.
struct Pattern {
  at::Tensor given_crow, given_col, crow, col;
};

/// It takes some thirty operations of torch, so the last few are kept for as long as the given indices live and nothing
/// is written into them, and taken again on the stream that made them. `may_keep` is false while a graph is captured,
/// whose memory is its own.
TransposedPattern transposed(const Pattern& pattern, bool may_keep);

}  // namespace prdp
