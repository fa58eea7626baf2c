#pragma once
#include <string_view>

#include "prdp_experiments/files/record.h"

namespace prdp {

/// Parses JSON. Raises ValueError for what is no JSON, and for values that are nested deeper than any record: readers
/// and destructors go down recursively.
Json parse_shallow(std::string_view text);

/// Raises ValueError, naming the key, what was found and what is expected, unless this is what the trainers write.
void check_training(const Json& record);

}  // namespace prdp
