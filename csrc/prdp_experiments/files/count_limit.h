#pragma once
#include <cstdint>

namespace prdp {

/// The largest number of seeds, intervals or iterations that a scene or a command may ask for. Costs are products of
/// these numbers, and the limit keeps them from overflowing.
inline constexpr int64_t kMostCounted = 1'000'000'000;

}  // namespace prdp
