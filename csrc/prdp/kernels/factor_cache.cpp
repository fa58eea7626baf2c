#include "prdp/kernels/factor_cache.h"

#include <algorithm>
#include <deque>
#include <mutex>

namespace prdp::factor_cache {

namespace {

// An operator and its transpose, where these differ.
constexpr size_t kMost = 2;
constexpr int64_t kMostBytes = int64_t{1} << 27;

struct Entry {
  std::string key;
  Factors factors;
};

std::mutex mutex;
std::deque<Entry> entries;  // the last used first
int64_t made = 0;

}  // namespace

Factors find(const std::string& key) {
  const std::lock_guard lock(mutex);
  for (auto it = entries.begin(); it != entries.end(); ++it) {
    if (it->key != key) continue;
    std::rotate(entries.begin(), it, it + 1);
    return entries.front().factors;
  }
  return nullptr;
}

void keep(std::string key, Factors factors, int64_t bytes) {
  const std::lock_guard lock(mutex);
  ++made;
  if (bytes + static_cast<int64_t>(key.size()) > kMostBytes) return;
  entries.push_front({std::move(key), std::move(factors)});
  if (entries.size() > kMost) entries.pop_back();
}

void clear() {
  const std::lock_guard lock(mutex);
  entries.clear();
}

int64_t count_made() {
  const std::lock_guard lock(mutex);
  return made;
}

}  // namespace prdp::factor_cache
