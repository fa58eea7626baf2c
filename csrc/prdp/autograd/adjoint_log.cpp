#include "prdp/autograd/adjoint_log.h"

#include <mutex>
#include <unordered_map>

namespace prdp::adjoint_log {

namespace {

/// A tensor that Python has seen takes the interpreter's lock when it is destroyed, and whoever holds that one
/// may be waiting for this mutex: nothing is destroyed while it is held.
struct Logs {
  std::mutex mutex;
  std::unordered_map<int64_t, std::unordered_map<int64_t, std::optional<SolveInfo>>> entries;  // by log, then by step
  int64_t last = 0;

  static constexpr int64_t kNumbers = kSteps + 1;
};

Logs& logs() {
  static auto* all = new Logs;  // outlives every backward thread
  return *all;
}

}  // namespace

int64_t open() {
  const std::lock_guard lock(logs().mutex);
  logs().entries[++logs().last];
  return logs().last * Logs::kNumbers;
}

void close(int64_t log) {
  decltype(Logs::entries)::node_type closed;
  const std::lock_guard lock(logs().mutex);
  closed = logs().entries.extract(log / Logs::kNumbers);
}

std::optional<SolveInfo> read(int64_t log) {
  const std::lock_guard lock(logs().mutex);
  const auto entry = logs().entries.find(log / Logs::kNumbers);
  if (entry == logs().entries.end()) return std::nullopt;
  const auto found = entry->second.find(log % Logs::kNumbers);
  return found == entry->second.end() ? std::nullopt : found->second;
}

void write(const c10::SymInt& to, const SolveInfo& info) {
  const int64_t log = to.expect_int();
  std::optional<SolveInfo> other = info;  // the new one, and then the one before it
  const std::lock_guard lock(logs().mutex);
  const auto entry = logs().entries.find(log / Logs::kNumbers);
  if (entry != logs().entries.end()) entry->second[log % Logs::kNumbers].swap(other);
}

}  // namespace prdp::adjoint_log
