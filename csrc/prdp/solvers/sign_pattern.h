#pragma once
#include <cmath>
#include <cstdint>

namespace prdp {

/// Signs without a pattern, the same for every sample: whether number i changes its own.
inline bool is_negated(int64_t i) { return std::sin(static_cast<double>((i + 1) * (i + 1))) < 0.0; }

}  // namespace prdp
