#include "prdp/solvers/kept_signs.h"

#include <vector>

#include "prdp/solvers/sample_numbers.h"

namespace prdp {

const char* first_signs(int64_t n) {
  constexpr int64_t most = 1 << 22;
  if (n > most) return nullptr;
  static thread_local std::vector<char> signs;
  signs.reserve(n);
  for (auto i = static_cast<int64_t>(signs.size()); i < n; ++i) signs.push_back(is_negated(i));
  return signs.data();
}

}  // namespace prdp
