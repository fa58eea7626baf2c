#pragma once
#include <cstdint>

namespace prdp {

/// What is_negated() of sample_numbers.h says of the first n numbers, 1 or 0: sines take longer than all else in an
/// estimate of rounding, so each thread keeps them. Null for more than it keeps.
const char* first_signs(int64_t n);

}  // namespace prdp
