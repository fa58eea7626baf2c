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
#endif

namespace {

/// What this processor can run, best last.
template <class T>
std::vector<const Loops<T>*> available();

template <>
std::vector<const Loops<float>*> available() {
  std::vector<const Loops<float>*> levels{&float_loops_baseline};
#ifdef PRDP_X86_LEVELS
  if (__builtin_cpu_supports("x86-64-v3")) levels.push_back(&float_loops_v3);
  if (__builtin_cpu_supports("x86-64-v4")) levels.push_back(&float_loops_v4);
#endif
  return levels;
}

template <>
std::vector<const Loops<double>*> available() {
  std::vector<const Loops<double>*> levels{&double_loops_baseline};
#ifdef PRDP_X86_LEVELS
  if (__builtin_cpu_supports("x86-64-v3")) levels.push_back(&double_loops_v3);
  if (__builtin_cpu_supports("x86-64-v4")) levels.push_back(&double_loops_v4);
#endif
  return levels;
}

template <class T>
const Loops<T>& choose() {
  const auto levels = available<T>();
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

template <class T>
const Loops<T>& loops() {
  static const Loops<T>& chosen = choose<T>();
  return chosen;
}
template const Loops<float>& loops<float>();
template const Loops<double>& loops<double>();

}  // namespace prdp::kernels
