// Loaded before libc: kills the process right after its n-th rename to a name that ends as $PRDP_KILL_AFTER says, such
// as ".pt:1". The next rename of a pair then never comes.
#include <dlfcn.h>

#include <csignal>
#include <cstdlib>
#include <string>

extern "C" int rename(const char* from, const char* to) {
  using Rename = int (*)(const char*, const char*);
  static const auto real = reinterpret_cast<Rename>(dlsym(RTLD_NEXT, "rename"));
  static int seen = 0;
  const int status = real(from, to);
  const char* where = std::getenv("PRDP_KILL_AFTER");
  if (!where || status != 0) return status;
  const std::string chosen(where), name(to);
  const auto colon = chosen.rfind(':');
  if (name.ends_with(chosen.substr(0, colon)) && ++seen == std::stoi(chosen.substr(colon + 1))) raise(SIGKILL);
  return status;
}
