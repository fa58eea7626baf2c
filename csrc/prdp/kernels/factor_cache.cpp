#include "prdp/kernels/factor_cache.h"

#include <algorithm>
#include <bit>
#include <list>
#include <mutex>

namespace prdp::kernels {

namespace {

constexpr uint64_t kMultiplier = 0x9fb21c651e98df25;

uint64_t mixed(uint64_t h) {
  h ^= h >> 32;
  h *= kMultiplier;
  h ^= h >> 29;
  h *= 0xbf58476d1ce4e5b9;
  return h ^ (h >> 32);
}

uint64_t combined(uint64_t lane, uint64_t word) { return std::rotl(lane ^ word, 29) * kMultiplier; }

}  // namespace

FactorKeyMaker& FactorKeyMaker::add_bytes(const unsigned char* bytes, int64_t count) {
  count_ = mixed(count_ ^ static_cast<uint64_t>(count));
  uint64_t words[4];
  int64_t at = 0;
  for (; at + 32 <= count; at += 32) {
    std::memcpy(words, bytes + at, 32);
    for (int i = 0; i < 4; ++i) lanes_[i] = combined(lanes_[i], words[i]);
  }
  if (at == count) return *this;
  std::memset(words, 0, 32);
  std::memcpy(words, bytes + at, static_cast<size_t>(count - at));
  for (int i = 0; i < 4; ++i) lanes_[i] = combined(lanes_[i], words[i]);
  return *this;
}

FactorKey FactorKeyMaker::key() const {
  uint64_t low = count_, high = ~count_;
  for (int i = 0; i < 4; ++i) {
    low = mixed(low ^ lanes_[i]);
    high = mixed(std::rotl(high, 17) + lanes_[3 - i]);
  }
  return {low, high};
}

}  // namespace prdp::kernels

namespace prdp::factor_cache {

namespace {

struct Entry {
  kernels::FactorKey key;
  const std::type_info* type;
  Kept kept;
  int64_t bytes;
};

std::mutex mutex;
std::list<Entry> entries;  // the last used first
int64_t bytes_of_all = 0, made = 0;

}  // namespace

int64_t limit() { return int64_t{1} << 29; }

Kept find(const kernels::FactorKey& key, const std::type_info& type) {
  const std::lock_guard lock(mutex);
  const auto it =
      std::find_if(entries.begin(), entries.end(), [&](const Entry& e) { return e.key == key && *e.type == type; });
  if (it == entries.end()) return nullptr;
  entries.splice(entries.begin(), entries, it);
  return it->kept;
}

void keep(const kernels::FactorKey& key, const std::type_info& type, Kept kept, int64_t bytes) {
  std::list<Entry> gone;  // destroyed without the lock
  const std::lock_guard lock(mutex);
  ++made;
  if (bytes > limit()) return;
  entries.push_front({key, &type, std::move(kept), bytes});
  bytes_of_all += bytes;
  while (bytes_of_all > limit()) {
    bytes_of_all -= entries.back().bytes;
    gone.splice(gone.begin(), entries, std::prev(entries.end()));
  }
}

void clear() {
  std::list<Entry> gone;
  const std::lock_guard lock(mutex);
  gone.swap(entries);
  bytes_of_all = 0;
}

int64_t count_made() {
  const std::lock_guard lock(mutex);
  return made;
}

}  // namespace prdp::factor_cache
