#include "prdp/autograd/adjoint_log.h"

#include <mutex>
#include <unordered_map>

namespace prdp::adjoint_log {

namespace {

struct Logs {
  std::mutex mutex;
  std::unordered_map<int64_t, std::optional<SolveInfo>> entries;
  int64_t last = 0;
};

Logs& logs() {
  static auto* all = new Logs;  // outlives every backward thread
  return *all;
}

}  // namespace

int64_t open() {
  const std::lock_guard lock(logs().mutex);
  logs().entries[++logs().last];
  return logs().last;
}

void close(int64_t log) {
  const std::lock_guard lock(logs().mutex);
  logs().entries.erase(log);
}

std::optional<SolveInfo> read(int64_t log) {
  const std::lock_guard lock(logs().mutex);
  const auto entry = logs().entries.find(log);
  return entry == logs().entries.end() ? std::nullopt : entry->second;
}

void write(int64_t log, const SolveInfo& info) {
  const std::lock_guard lock(logs().mutex);
  const auto entry = logs().entries.find(log);
  if (entry != logs().entries.end()) entry->second = info;
}

}  // namespace prdp::adjoint_log
