#pragma once
#include <cstdint>

#include "prdp/threads/interruption.h"
#include "prdp/threads/share_rows.h"

namespace prdp {

/// Shares a batch among threads: by its samples or, where there are fewer of them than threads and they are large, by
/// the rows of each.
template <class Body>
void share_samples(int64_t size, int64_t unknowns, int64_t grain, const Body& body) {
  const bool by_rows = size < at::get_num_threads() && unknowns >= 4 * share_rows::kBlock && !at::in_parallel_region();
  const share_rows::Scope rows(by_rows);
  if (by_rows) body(0, size);
  else interruption::parallel_for(0, size, grain, body);
}

}  // namespace prdp
