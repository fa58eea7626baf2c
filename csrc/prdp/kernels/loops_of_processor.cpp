#include <c10/util/Exception.h>

#include <cstdlib>
#include <string>
#include <vector>

#include "prdp/kernels/loops.h"

namespace prdp::kernels {

extern const Loops<float> float_loops_baseline;
extern const Loops<double> double_loops_baseline;
#ifdef PRDP_X86_LEVELS
extern const Loops<float> float_loops_v3, float_loops_v4;
extern const Loops<double> double_loops_v3, double_loops_v4;
#define PRDP_ALL_LEVELS(type) {&type##_loops_baseline, &type##_loops_v3, &type##_loops_v4}
#else
#define PRDP_ALL_LEVELS(type) {&type##_loops_baseline}
#endif

namespace {

/// How many of the levels, from the lowest, this processor has.
size_t supported() {
#ifdef PRDP_X86_LEVELS
  if (__builtin_cpu_supports("x86-64-v4")) return 3;
  if (__builtin_cpu_supports("x86-64-v3")) return 2;
#endif
  return 1;
}

template <class T>
const Loops<T>& choose(std::vector<const Loops<T>*> levels) {
  levels.resize(supported());
  const char* wanted = std::getenv("PRDP_CPU_LEVEL");
  if (!wanted || !*wanted) return *levels.back();
  std::string names;
  for (const auto* level : levels) {
    if (std::string_view(level->level) == wanted) return *level;
    names += (names.empty() ? "" : ", ") + std::string(level->level);
  }
  TORCH_CHECK_VALUE(false, "PRDP_CPU_LEVEL: this processor has no level '", wanted, "'; allowed: ", names);
}

}  // namespace

template <>
const Loops<float>& loops() {
  static const auto& chosen = choose<float>(PRDP_ALL_LEVELS(float));
  return chosen;
}
template <>
const Loops<double>& loops() {
  static const auto& chosen = choose<double>(PRDP_ALL_LEVELS(double));
  return chosen;
}

}  // namespace prdp::kernels
